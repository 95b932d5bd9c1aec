"""Quantities are displayed in the units in which the user wrote them: in the plant file, or in the recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from fdi_torch import Pipe, Plant, Pump, Sensor, Tank
from fdi_torch.cli import NOT_EXPLAINED, main
from fdi_torch.config.loaded_recordings import read_recording
from fdi_torch.config.plant_file import build_plant, load_plant
from fdi_torch.config.plant_patch import patched_plant
from fdi_torch.config.plant_writer import dump_plant
from fdi_torch.config.problems import ConfigError
from fdi_torch.estimate.misfit import flow_words
from fdi_torch.gap.answer import with_constants
from fdi_torch.jobs.report import report
from fdi_torch.plant.description import PlacedEffect
from fdi_torch.plant.scales import tank_table
from fdi_torch.quantities import display_in, display_unit, displayed_in, quantity_text, volume_unit

PLANT = """name: rig
tanks:
  A: {area: 16000 mm^2, height: 500 mm, leak_reference: OUT}
pipes:
  OUT: {source: A, target: outside, area: 60 mm^2, discharge_coefficient: 0.6}
pumps:
  Q: {target: A, max_flow: 6 l/min}
sensors:
  h: {tank: A}
  p: {tank: A, gain: 200 %/m}
tolerances: {"*.discharge_coefficient": 3 %}
"""
RUN = """plant: plant.yaml
simulate:
  inputs: {Q: {steps: [[0 s, 3 l/min], [60 s, 4 l/min]]}}
  duration: 120 s
  faults: {A.leak: 0.2}
  noise: {std: {h: 1 mm, p: 0.2 %}}
output: {name: run}
"""
FIT = """plant: plant.yaml
recordings: [{file: run.csv}]
estimate: {parameters: [A.leak], search: {population: 20, evaluations: 2000}}
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    for name, text in (("plant", PLANT), ("run", RUN), ("fit", FIT)):
        (tmp_path / f"{name}.yaml").write_text(text)
    return tmp_path


def test_a_plant_file_decides_the_units() -> None:
    units = build_plant(yaml.safe_load(PLANT), "plant.yaml").units
    assert units == {"m": "mm", "m^2": "mm^2", "m^3/s": "l/min", "1/m": "%/m", "p": "%"}


def test_a_gain_per_per_cent_is_displayed_as_written() -> None:
    text = PLANT.replace("max_flow: 6 l/min}", "max_flow: 6 l/min, gain: 0.06 l/min/%}")
    plant = build_plant(yaml.safe_load(text), "plant.yaml")
    assert plant.units["Q.gain"] == "l/min/%" and plant.units["Q"] == "%"
    with displayed_in(plant.units):
        assert quantity_text(1e-4, "m^3/s", name="Q.gain") == "0.06 l/min/%"
    assert "gain: 0.06 l/min/%" in dump_plant(plant) and "units:" not in dump_plant(plant)
    pump = Pump("Q", "A", max_flow="6 l/min", gain="0.06 l/min/%", command="SIC1")
    rig = Plant(plant.tanks, plant.pipes, [pump], plant.sensors)
    assert rig.units["Q.gain"] == "l/min/%" and rig.units["SIC1"] == "%"
    chosen = build_plant(yaml.safe_load(text) | {"units": {"Q.gain": "m^3/h/%"}}, "plant.yaml")
    assert build_plant(yaml.safe_load(dump_plant(chosen)), "again").units == chosen.units


def test_a_plant_in_code_is_displayed_as_it_was_written() -> None:
    tank = Tank("A", area="16000 mm^2", height="500 mm", leak_reference="OUT")
    pipe = Pipe("OUT", "A", "outside", area="60 mm^2", discharge_coefficient=0.6)
    sensors = [Sensor("h", "A"), Sensor("p", "A", gain="200 %/m", channel="LI7")]
    rig = Plant([tank], [pipe], [Pump("Q", "A", max_flow="6 l/min")], sensors)
    assert rig.units == {"m": "mm", "m^2": "mm^2", "m^3/s": "l/min", "1/m": "%/m", "LI7": "%"}
    assert replace(rig, name="other").units == rig.units
    assert Plant([Tank("A", 0.02, 0.6)], sensors=[Sensor("h", "A")]).units == {}
    assert Plant([tank], [pipe], rig.pumps, sensors, units={"m": "in"}).units == rig.units | {"m": "in"}


def test_the_key_units_overrides_what_is_written() -> None:
    data = yaml.safe_load(PLANT) | {"units": {"m": "in", "p": "%"}}
    assert build_plant(data, "plant.yaml").units["m"] == "in"
    for wrong, complaint in (({"m": "l/min"}, "units.m: expected a unit that converts to m"), ({"x": "mm"}, "units: ")):
        with pytest.raises(ConfigError, match=complaint):
            build_plant(yaml.safe_load(PLANT) | {"units": wrong}, "plant.yaml")


def test_quotients_follow_their_parts() -> None:
    with displayed_in({"m^3/s": "l/min", "m": "mm"}):
        assert display_unit("m^3/s/V") == ("l/min/V", pytest.approx(6e4))
        assert display_unit("V/m") == ("V/mm", pytest.approx(1e-3))
    assert display_unit("m^3/s/A")[0] == "cm^3/s/mA" and display_unit("1/s") == ("1/s", 1.0)


def test_a_channel_may_have_its_own_unit() -> None:
    display_in({"m": "mm", "h": "in", "Q": "%"})
    assert quantity_text(0.0254, "m", name="h") == "1 in"
    assert quantity_text(0.0254, "m", name="other") == "25.4 mm"
    assert quantity_text(1e-3, "m^3/s", name="Q") == "1000 cm^3/s"  # a Q of another recording, measured in %


def test_units_survive_the_log_and_the_plant_file() -> None:
    plant = build_plant(yaml.safe_load(PLANT) | {"units": {"m": "in"}}, "plant.yaml")
    again = build_plant(yaml.safe_load(dump_plant(plant)), "again")
    assert again == plant and again.units == plant.units
    plain = build_plant(yaml.safe_load(PLANT), "plant.yaml")
    assert "height: 500 mm" in dump_plant(plain) and "max_flow: 6 l/min" in dump_plant(plain)
    assert "units:" not in dump_plant(plain)


def test_holes_and_volumes_follow_a_plant_in_inches_and_gallons() -> None:
    text = PLANT.replace("16000 mm^2", "31 in^2").replace("500 mm", "24 in").replace("6 l/min", "1.6 gal/min")
    plant = build_plant(yaml.safe_load(text.replace("60 mm^2", "0.093 in^2")), "plant.yaml")
    with displayed_in(plant.units):
        assert flow_words(6.309e-5, 0.00508, True) == (
            "changes the flow by 1 gal/min at the mean levels, as a sharp-edged hole of 0.2 in would"
        )
        table = tank_table(plant)
    assert table.header[1:4] == ("area, in^2", "height, in", "volume, gal")
    assert table.rows[0][3] == pytest.approx(31.0 * 24.0 / 231.0)  # a US gallon has 231 cubic inches
    with displayed_in({"m": "m", "m^3/s": "m^3/h"}):
        assert "hole of 5.08 mm" in flow_words(6.309e-5, 0.00508, True) and volume_unit() == "l"


def test_an_adopted_effect_is_written_in_the_units_of_the_file() -> None:
    before = build_plant(yaml.safe_load(PLANT), "rig")
    effect = PlacedEffect("laminar_flow", "OUT", {"transition_head": 0.0498106, "softness": 0.5})
    after = with_constants(before, {"A.start_level": 0.123456789012})
    text, kept = patched_plant(PLANT, before, build_plant(yaml.safe_load(dump_plant(after)), "rig"))
    assert kept and "start_level: 123.4568 mm" in text
    text, kept = patched_plant(PLANT, before, replace(before, effects=(effect,)))
    assert kept and "transition_head: 49.8106 mm" in text


def test_terminal_files_and_page_use_the_units_of_the_plant_file(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["simulate", "--config", "run.yaml", "--out", "."]) == 0
    assert (folder / "run.csv").read_text().startswith("t_s,Q_l/min,h_mm,p_pct\n0,3,")
    assert main(["check", "run.csv", "--plant", "plant.yaml"]) == 0
    assert main(["train", "--config", "fit.yaml"]) == 0
    assert main(["predict", "run.csv", "--plant", "plant.yaml"]) == NOT_EXPLAINED  # the plant file has no leak
    said = capsys.readouterr().out
    assert "A.start_level" in said and "l/min at the mean levels" in said and "h, mm" in said and "p, %" in said
    page = report(folder / "logs" / "fit.mcap").page.read_text()
    body = page[page.index("<body") :]
    assert "level, mm" in body and "l/min" in body
    for text in (said, body):
        assert not any(unit in text for unit in (" cm", "cm³/s", "cm^3/s"))
    assert display_unit("m")[0] == "cm"  # the commands left nothing behind


def test_a_channel_is_displayed_in_the_unit_of_its_column(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["simulate", "--config", "run.yaml", "--out", "."])
    lines = (folder / "run.csv").read_text().splitlines()
    inches = ["t_s,Q_l/min,h_in,p_pct", *(row for row in lines[1:])]
    (folder / "run.csv").write_text("\n".join(inches))
    recording = read_recording("run.csv", load_plant("plant.yaml"))
    assert recording.written == {"t": "s", "Q": "l/min", "h": "in", "p": "%"}
    assert display_unit("m", "h")[0] == "in" and display_unit("m^3/s")[0] == "l/min"
    assert recording.origin["unit.h"] == "in"
