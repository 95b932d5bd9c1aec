"""Plant files: the shipped plants have the documented values, and every invalid file is refused in one sentence."""

from __future__ import annotations

import math
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import yaml

import fdi_torch
from fdi_torch.config.plant_file import build_plant, load_plant
from fdi_torch.config.plant_writer import dump_plant
from fdi_torch.config.problems import ConfigError
from fdi_torch.config.yaml_files import SHIPPED

PLANTS = sorted(path.stem for path in (SHIPPED / "plants").glob("*.yaml"))

GOOD: dict[str, Any] = {
    "tanks": {"T1": {"area": "160 cm^2", "height": "100 cm"}, "T2": {"area": "160 cm^2", "height": "1 m"}},
    "pipes": {"P12": {"source": "T1", "target": "T2", "area": "0.6 cm^2", "discharge_coefficient": 0.6}},
    "pumps": {"Q1": {"target": "T1", "max_flow": "90 cm^3/s"}},
    "sensors": {"h1": {"tank": "T1"}},
}


def changed(path: str, value: Any) -> dict[str, Any]:
    data = deepcopy(GOOD)
    node = data
    *parents, last = path.split(".")
    for key in parents:
        node = node.setdefault(key, {})
    node[last] = value
    return data


@pytest.mark.parametrize(("name", "title"), [("", "plant"), ("plant", "plant"), ("bench", "plant bench")])
def test_a_plant_without_a_name_is_called_the_plant(name: str, title: str) -> None:
    with pytest.raises(ConfigError, match=f"^p.yaml: {title}: tanks.T1.area: expected a positive number"):
        build_plant({"name": name, **changed("tanks.T1.area", "0 m^2")}, "p.yaml")


def test_three_tank_is_table_1() -> None:
    plant = load_plant("three_tank")
    assert [t.name for t in plant.tanks] == ["T1", "T2", "T3"]
    assert {(t.area, t.height) for t in plant.tanks} == {(0.016, 1.0)}
    assert {p.name: (p.source, p.target) for p in plant.pipes} == {
        "P13": ("T1", "T3"),
        "P32": ("T3", "T2"),
        "OUT2": ("T2", "outside"),
    }
    assert [p.area for p in plant.pipes] == pytest.approx([0.6e-4] * 3)
    assert {p.discharge_coefficient for p in plant.pipes} == {0.6}
    assert [(p.name, p.target, p.max_flow) for p in plant.pumps] == [
        ("Q1", "T1", pytest.approx(90e-6)),
        ("Q2", "T2", pytest.approx(90e-6)),
    ]
    assert plant.channels() == ("Q1", "Q2")
    assert plant.gravity == 9.81
    assert plant.tolerances == {f"{p}.discharge_coefficient": 0.03 for p in ("P13", "P32", "OUT2")}


def test_volts_and_duty_are_told_by_the_units_of_the_gains() -> None:
    cascade = load_plant("cascaded_tanks")
    assert cascade.channel_units() == {"u_pump": "V"}
    assert (cascade.sensors[0].unit, cascade.sensors[0].gain) == ("V", pytest.approx(50.0))
    assert load_plant("three_tank_leak").channel_units() == {"pwm1": "1", "pwm3": "1"}


def test_a_number_that_is_short_in_no_unit_is_written_in_the_unit_of_the_plant() -> None:
    bore = math.pi / 4.0 * 0.009**2
    plant = fdi_torch.Plant(
        tanks=[fdi_torch.Tank("A", area="2 dm^2", height="60 cm")],
        pipes=[fdi_torch.Pipe("out", "A", "outside", area=bore, discharge_coefficient=0.6)],
        sensors=[fdi_torch.Sensor("h", "A")],
    )
    written = yaml.safe_load(dump_plant(plant))
    assert written["tanks"]["A"]["area"] == "2 dm^2"
    number, unit = written["pipes"]["out"]["area"].split()
    assert unit == "dm^2" and float(number) == pytest.approx(100.0 * bore, rel=1e-15)
    assert build_plant(written, "again").pipes == plant.pipes


@pytest.mark.parametrize(
    ("tank_area", "pipe_area", "written"),
    [
        ("2 m^2", "3.2 cm^2", ("2 m^2", "3.2 cm^2")),
        ("2 m^2", 5e-7, ("2 m^2", "0.5 mm^2")),
    ],
)
def test_areas_are_written_in_units_of_their_size(tank_area: Any, pipe_area: Any, written: tuple[str, str]) -> None:
    plant = fdi_torch.Plant(
        tanks=[fdi_torch.Tank("A", area=tank_area, height="3 m")],
        pipes=[fdi_torch.Pipe("out", "A", "outside", area=pipe_area, discharge_coefficient=0.6)],
        sensors=[fdi_torch.Sensor("h", "A")],
    )
    data = yaml.safe_load(dump_plant(plant))
    assert (data["tanks"]["A"]["area"], data["pipes"]["out"]["area"]) == written
    assert build_plant(data, "again") == plant


@pytest.mark.parametrize(
    ("gain", "unit", "reading"),
    [("98.1 mbar/m", "Pa", 9810.0), ("1.42 psi/m", "Pa", 9790.56), ("16 mA/m", "A", 0.016), ("2 %/cm", "1", 2.0)],
)
def test_a_sensor_reads_a_pressure_a_current_or_a_share(gain: str, unit: str, reading: float) -> None:
    plant = build_plant(changed("sensors.h1.gain", gain), "p.yaml")
    assert (plant.sensors[0].unit, plant.sensors[0].gain) == (unit, pytest.approx(reading, rel=1e-4))
    assert build_plant(yaml.safe_load(dump_plant(plant)), "again") == plant


@pytest.mark.parametrize(
    ("gain", "unit", "flow"), [("10 l/min/mA", "A", 1 / 6), ("1 cm^3/s/Hz", "1/s", 1e-6), ("5 l/min", "1", 1 / 12000)]
)
def test_a_pump_follows_a_current_a_frequency_or_a_duty(gain: str, unit: str, flow: float) -> None:
    plant = build_plant(changed("pumps.Q1.gain", gain), "p.yaml")
    assert (plant.channel_units(), plant.pumps[0].gain) == ({"Q1": unit}, pytest.approx(flow))
    assert build_plant(yaml.safe_load(dump_plant(plant)), "again") == plant


def test_a_sensor_has_its_limits_and_the_tolerance_of_its_offset_in_its_own_unit() -> None:
    data = GOOD | {
        "sensors": {"y": {"tank": "T1", "gain": "20 V/m", "offset": "1 V", "low": "500 mV", "high": "9 V"}},
        "tolerances": {"y.offset": "50 mV", "y.gain": "2 %"},
    }
    plant = build_plant(data, "rig.yaml")
    sensor = plant.sensors[0]
    assert (sensor.unit, sensor.offset, sensor.low, sensor.high) == ("V", 1.0, 0.5, 9.0)
    assert plant.tolerances == {"y.offset": 0.05, "y.gain": 0.02}


def test_quadruple_tank_splits_each_pump_by_its_valve() -> None:
    """gamma_i k_i into the lower tank and (1 - gamma_i) k_i across into the upper one (Johansson 2000, eq. 1)."""
    gains = {p.target: (p.channel, p.gain * 1e6) for p in load_plant("quadruple_tank").pumps}
    assert gains == {
        "T1": ("v1", pytest.approx(0.7 * 3.33)),
        "T4": ("v1", pytest.approx(0.3 * 3.33)),
        "T2": ("v2", pytest.approx(0.6 * 3.35)),
        "T3": ("v2", pytest.approx(0.4 * 3.35)),
    }


@pytest.mark.parametrize("name", PLANTS)
def test_a_plant_reads_back_as_it_was_written(name: str) -> None:
    plant = load_plant(name)
    assert build_plant(yaml.safe_load(dump_plant(plant)), "again") == plant


def test_numbers_without_a_short_form_read_back_to_the_last_bit() -> None:
    data = changed("tanks.T1.area", f"{0.1 + 0.2} m^2")
    leak = {"effect": "leak", "location": "T1", "parameters": {"size": 1 / 3, "onset": "1 minute", "height": "7 mm"}}
    data["effects"] = [leak]
    plant = build_plant(data, "plant.yaml")
    assert plant.effects[0].parameters == {"size": 1 / 3, "onset": 60.0, "height": 0.007}
    assert build_plant(yaml.safe_load(dump_plant(plant)), "again") == plant


@pytest.mark.parametrize(
    ("path", "value", "sentence"),
    [
        ("tanks.T1.aera", "1 m^2", "p.yaml: tanks.T1: expected a known key .* got 'aera'; the nearest is 'area'"),
        ("pump", {}, "p.yaml: expected a known key .* got 'pump'; the nearest is 'pumps'"),
        ("tanks.T1.area", "160 cm", "p.yaml: tanks.T1.area: expected a quantity in m\\^2 .* got '160 cm'"),
        ("tanks.T1.area", 160, "p.yaml: tanks.T1.area: .* got the bare number 160; write its unit, such as cm.2$"),
        ("tanks.T1.area", True, "p.yaml: tanks.T1.area: expected a quantity in m\\^2, got True"),
        (
            "tanks.T1.area",
            "nan m^2",
            "p.yaml: tanks.T1.area: expected a quantity in m\\^2 such as '1 m\\^2', got 'nan m",
        ),
        ("tanks.T1.area", "-160 cm^2", "p.yaml: plant p: tanks.T1.area: expected a positive number, got -160 cm\\^2"),
        ("pumps.Q1.max_flow", "12 L/mn", "got '12 L/mn'; the unit L/mn is unknown; the nearest is 'l/min'$"),
        ("tanks.T1.area", "10,000 cm^2", "got '10,000 cm\\^2'; write 10.5 for decimals, and 10000 without a separator"),
        (
            "pipes.P12.discharge_coefficient",
            "0,6",
            "expected a number or a share such as '30 %', got '0,6'; write 10.5",
        ),
        (
            "tanks.T1.start_level",
            "101 cm",
            "tanks.T1.start_level: expected a level from the floor to 100 cm, got 101 cm",
        ),
        ("tanks.T1.start_level", "-1 cm", "tanks.T1.start_level: expected a level from the floor to 100 cm, got -1 cm"),
        ("tanks.T3", {"area": "1 m^2"}, "p.yaml: tanks.T3.height: expected a value, got nothing; add it"),
        ("tanks", [], "p.yaml: tanks: expected keys with values, got \\[\\]"),
        ("tanks", {}, "expected at least one tank, got none"),
        ("pipes.P12.target", "T9", "pipes.P12.target: expected one of the tanks T1, T2, outside, got 'T9'"),
        ("pipes.P12.target", "T1", "pipes.P12: expected two different ends, got T1 twice"),
        ("pipes.P12.area", "0 cm^2", "pipes.P12.area: expected a positive number, got 0 cm\\^2"),
        ("pumps.Q9", {"max_flow": "1 l/s"}, "p.yaml: pumps.Q9.target: expected a value, got nothing; add it"),
        ("pumps.Q1.target", "T9", "pumps.Q1.target: expected one of the tanks T1, T2, got 'T9'"),
        ("pumps.Q1.gain", "3 kg", "pumps.Q1.gain: expected a quantity in 1 or m\\^3/s/V or m\\^3/s/A or .* got '3 kg'"),
        ("pumps.T1", {"target": "T1", "max_flow": "1 l/s"}, "expected each name once, got 'T1' twice"),
        ("sensors.h1.tank", "T9", "sensors.h1.tank: expected one of the tanks T1, T2, got 'T9'"),
        ("sensors.h1.gain", 0, "sensors.h1.gain: expected a number other than 0, got 0"),
        ("sensors.h1.offset", "3 V", "sensors.h1.offset: expected a quantity in m .* got '3 V'"),
        ("tanks.T1.overflow_to", "T9", "tanks.T1.overflow_to: expected one of the tanks"),
        ("tanks.T1.leak_reference", "P9", "tanks.T1.leak_reference: expected one of the pipes P12, got 'P9'"),
        ("tolerances", {"P12.discharge": 0.1}, "got 'P12.discharge'; the nearest is 'P12.discharge_coefficient'"),
        ("tolerances", {"*.area": 10}, "expected a share of T1.area up to 100 %, such as 3 %, got 10"),
        ("tolerances", {"*.area": "-3 %"}, "tolerances.\\*.area: expected a positive tolerance such as 3 %, got -3 %"),
        (
            "effects",
            [{"effect": "leak", "location": "T1", "parameters": {"height": "3 s"}}],
            "p.yaml: effects.0.parameters.height: expected a quantity in m .* got '3 s'",
        ),
        (
            "effects",
            [{"effect": "leak", "location": "T1", "parameters": {"hight": "3 cm"}}],
            "effects.0.parameters: expected a parameter of leak .* the nearest is 'height'",
        ),
        ("effects", [{"effect": "leek", "location": "T1"}], "effects.0: expected an effect of the library, got 'leek'"),
        (
            "effects",
            [{"effect": "leak", "location": "Q1"}],
            "effects.0: Q1.leak: expected a place of kind tank .* got pump Q1",
        ),
        ("effects", [{"effect": "leak", "location": "t1"}], "effects.0: plant p: .* got t1; the nearest is 'T1'"),
        ("effects", [{"effect": "leak", "location": "T9"}], "effects.0: plant p: expected one of .* got T9"),
    ],
)
def test_an_impossible_plant_is_refused_in_one_sentence(path: str, value: Any, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence) as error:
        build_plant({"name": "p", **changed(path, value)}, "p.yaml")
    assert len(error.value.problems) == 1


def test_a_plant_file_is_found_by_shipped_name_by_folder_and_by_path(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(GOOD))
    assert load_plant("mine.yaml", tmp_path).name == "mine"
    assert load_plant(tmp_path / "mine.yaml") == load_plant("mine.yaml", tmp_path)
    with pytest.raises(ConfigError, match=r"mime.yaml: file not found .* the nearest is 'mine.yaml'"):
        load_plant("mime.yaml", tmp_path)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("tanks: [", "line 1: not valid YAML"),
        ("tanks: {}\nsensors: {h1: {tank: T1}, h1: {tank: T2}}", "line 2: expected each key once, got h1 twice"),
        ("- 1", "expected keys and values .* got a list"),
        ("", "got nothing"),
    ],
)
def test_a_file_without_a_mapping_is_refused(tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "p.yaml").write_text(text)
    with pytest.raises(ConfigError, match=sentence):
        load_plant("p.yaml", tmp_path)
