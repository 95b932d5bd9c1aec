"""Units that are wrong for all areas, flows, levels or times: every command names them before it computes."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

import fdi_torch
from fdi_torch.cli import MISUSE, NOT_EXPLAINED, main
from fdi_torch.config.plant_file import build_plant, load_plant
from fdi_torch.gap.preprocess.acquisition import CheckedRecording
from fdi_torch.plant.description import PlacedEffect, PlantDescription
from fdi_torch.quantities import display_in
from fdi_torch.recordings.check import data_warnings
from fdi_torch.recordings.plant_units import doubtful_units, excessive_flows, wrong_units
from fdi_torch.recordings.volume_balance import balance_along

PLANT = """
tanks:
  A: {area: 200 cm^2, height: 60 cm}
  B: {area: 150 cm^2, height: 60 cm}
pipes:
  AB: {source: A, target: B, area: 0.8 cm^2, discharge_coefficient: 0.6}
  OUT: {source: B, area: 0.8 cm^2, discharge_coefficient: 0.6}
pumps: {Q: {target: A, max_flow: 6 l/min}}
sensors: {hA: {tank: A}, hB: {tank: B}}
tolerances: {"*.discharge_coefficient": 5 %, Q.gain: 3 %}
"""
STEPS = [["0 s", "3 l/min"], ["100 s", "4.5 l/min"], ["250 s", "2 l/min"], ["400 s", "3.5 l/min"]]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The plant, and ten minutes of it with another gain of the pump than the file has, in run.csv."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.yaml").write_text(PLANT)
    run = recorded(load_plant(tmp_path / "rig.yaml"), {"Q.pump_gain": 0.97})
    (tmp_path / "run.csv").write_text("t_s,Q_l/min,hA_mm,hB_mm\n" + rows(run))
    (tmp_path / "train.yaml").write_text(
        "plant: rig.yaml\nrecordings: [{file: run.csv}]\nestimate: {parameters: [B.leak]}\n"
    )
    (tmp_path / "watch.yaml").write_text("plant: rig.yaml\nrecording: {file: run.csv}\nfault_free: [0 s, 600 s]\n")
    return tmp_path


def recorded(plant: PlantDescription, faults: dict[str, float | str]) -> fdi_torch.Recording:
    noise = {"std": {"hA": "1 mm", "hB": "1 mm"}}
    return fdi_torch.simulate(plant, inputs={"Q": {"steps": STEPS}}, duration="600 s", faults=faults, noise=noise)


def rows(run: fdi_torch.Recording) -> str:
    each = zip(run.time.tolist(), run.inputs[:, 0].tolist(), *run.outputs.T.tolist(), strict=True)
    return "".join(f"{t},{6e4 * q},{1e3 * a},{1e3 * b}\n" for t, q, a, b in each)


each_command = pytest.mark.parametrize(
    "command",
    [
        ["gap", "--plant", "rig.yaml", "--recording", "run.csv"],
        ["refit", "--plant", "rig.yaml", "--recording", "run.csv"],
        ["train", "--config", "train.yaml"],
        ["monitor", "--config", "watch.yaml"],
    ],
    ids=lambda words: words[0],
)


@each_command
def test_every_command_refuses_many_times_what_a_pump_delivers(
    folder: Path, command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    recording = folder / "run.csv"
    recording.write_text(recording.read_text().replace("Q_l/min", "Q_L/s"))
    assert main([*command, "--quiet"]) == MISUSE
    assert (
        "Q: up to 4.5 L/s, 45 times Q's maximum of 0.1 L/s; if its unit is L/min, write columns: {Q: {unit: L/min}}; "
        "otherwise correct max_flow of Q; if the recording is right"
    ) in capsys.readouterr().err


def test_the_unit_that_the_refusal_of_a_flow_names_is_right(folder: Path) -> None:
    recording = folder / "run.csv"
    recording.write_text(recording.read_text().replace("Q_l/min", "Q_L/s"))
    plant, entry = load_plant(folder / "rig.yaml"), {"file": str(recording)}
    assert excessive_flows(plant, fdi_torch.read_recording(entry, plant))
    right = fdi_torch.read_recording({**entry, "columns": {"Q": {"unit": "L/min"}}}, plant)
    assert float(right.inputs.max()) == pytest.approx(4.5e-3 / 60.0) and not excessive_flows(plant, right)
    single = right.inputs.clone()
    single[3] = 1.0
    assert not excessive_flows(plant, replace(right, inputs=single)), "one bad value is no wrong unit"
    assert not excessive_flows(plant, replace(right, inputs=5.0 * right.inputs)), "as a controller may ask"


def test_gap_refuses_one_level_in_a_wrong_unit_that_lies_above_the_rim(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Readings above a rim are accepted, but not where the volume balance names the unit that explains them."""
    recording = folder / "run.csv"
    recording.write_text(recording.read_text().replace("hB_mm", "hB_cm"))
    assert main(["gap", "--plant", "rig.yaml", "--recording", "run.csv", "--quiet"]) == MISUSE
    sentence = "the level hB is 10 times too large (write mm in place of cm), unless hB does not follow the level"
    assert f"{sentence}; if the recording is right" in capsys.readouterr().err


@each_command
def test_every_command_refuses_areas_in_the_wrong_unit_with_one_sentence(
    folder: Path, command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "rig.yaml").write_text(PLANT.replace("200 cm^2", "200 m^2").replace("150 cm^2", "150 m^2"))
    assert main([*command, "--quiet"]) == MISUSE
    sentence = "the areas of all tanks are 10000 times too large (write cm^2 in place of m^2)"
    assert f"by the volume balance of the tanks, {sentence}; if the recording is right" in capsys.readouterr().err


def in_file(old: str, new: str) -> Callable[[str], str]:
    return lambda text: text.replace(old, new)


@pytest.mark.parametrize(
    ("name", "change", "sentence"),
    [
        ("rig.yaml", in_file("200 cm^2", "200 m^2"), "tanks.A.area is 10000 times too large"),
        ("rig.yaml", in_file("0.8 cm^2", "0.8 mm^2"), "the areas of all pipes are 100 times too small"),
        (
            "rig.yaml",
            in_file("cm^2", "m^2"),
            "the areas of all tanks and pipes are 10000 times too large (write cm^2 in place of m^2)",
        ),
        (
            "run.csv",
            in_file("l/min", "cm^3/s"),
            "the flows of Q are 16.7 times too small (write l/min in place of cm^3/s)",
        ),
        ("run.csv", in_file("t_s", "t_min"), "the times are 60 times too large (write s in place of min)"),
        ("run.csv", in_file("mm", "cm"), "the levels hA, hB are 10 times too large (write mm in place of cm)"),
    ],
)
def test_check_names_what_is_wrong_and_what_to_write(
    folder: Path, name: str, change: Callable[[str], str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / name).write_text(change((folder / name).read_text()))
    assert main(["check", "run.csv", "--plant", "rig.yaml"]) == NOT_EXPLAINED
    shown = capsys.readouterr().out
    assert f"- units: by the volume balance of the tanks, {sentence}" in shown
    assert " or " not in shown.split(sentence)[1].splitlines()[0]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (
            in_file("200 cm^2", "20 cm^2"),
            "tanks.A.area is 10 times too small (write 200 cm^2 in place of 20 cm^2), unless hA ",
        ),
        (
            in_file("150 cm^2", "1500 cm^2"),
            "tanks.B.area is 10 times too large (write 150 cm^2 in place of 1500 cm^2), unless hB ",
        ),
    ],
)
def test_an_area_off_by_ten_is_a_doubt(
    folder: Path, change: Callable[[str], str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """It does not refuse the recording: a float that sticks looks the same."""
    (folder / "rig.yaml").write_text(change((folder / "rig.yaml").read_text()))
    assert main(["check", "run.csv", "--plant", "rig.yaml"]) == NOT_EXPLAINED
    assert f"by the volume balance of the tanks, {sentence}" in capsys.readouterr().out
    assert main(["predict", "--plant", "rig.yaml", "--recording", "run.csv"]) != MISUSE


@pytest.mark.parametrize(
    "faults",
    [
        {},
        {"Q.pump_gain": 0.6},
        {"B.leak": 0.5},
        {"AB.plugging": 0.9},
        {"Q.pump_lag": "20 s"},
        {"hA.sensor_gain": 0.8},
        {"B.leak": 0.3, "AB.plugging": 0.4},
    ],
    ids=str,
)
def test_a_faulty_plant_is_no_wrong_unit(folder: Path, faults: dict[str, float | str]) -> None:
    plant = load_plant(folder / "rig.yaml")
    assert wrong_units(plant, recorded(plant, faults)) == ""


def test_a_wrong_unit_beside_a_fault_is_said_first_by_train_as_by_check(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The quick check before a fit may miss it, as here, where it finds nothing at all."""
    faults: dict[str, float | str] = {"A.leak": 0.3, "AB.plugging": 0.3}
    faults |= {"A.leak.onset": "300 s", "AB.plugging.onset": "300 s"}
    run = recorded(load_plant(folder / "rig.yaml"), faults)
    run = replace(run, inputs=0.1 * run.inputs)
    (folder / "run.csv").write_text("t_s,Q_l/min,hA_mm,hB_mm\n" + rows(run))
    assert main(["check", "run.csv", "--plant", "rig.yaml"]) == NOT_EXPLAINED
    wrong = "Q: its unit seems wrong: its values are 10 times too small"
    assert f"- {wrong}" in capsys.readouterr().out
    monkeypatch.setattr("fdi_torch.jobs.run_setup.usable", lambda plant, run: CheckedRecording(run, (), None))
    assert main(["train", "--config", "train.yaml"]) != MISUSE
    assert capsys.readouterr().out.startswith(f"Doubts about the recording:\n- {wrong}")


def test_a_recording_without_metered_flows_or_too_short_says_nothing(folder: Path) -> None:
    run = recorded(load_plant(folder / "rig.yaml"), {})
    (folder / "large.yaml").write_text(PLANT.replace("200 cm^2", "200 m^2").replace("150 cm^2", "150 m^2"))
    large = load_plant(folder / "large.yaml")
    display_in(large.units)
    assert wrong_units(large, run.stretch(0, 32)) == "" != wrong_units(large, run)
    unmetered = replace(run, inputs=0.0 * run.inputs)
    assert wrong_units(large, unmetered) == ""
    assert wrong_units(large, replace(unmetered, outputs=0.0 * run.outputs)) == ""


def test_a_sensor_that_shows_zero_throughout_is_no_wrong_unit(folder: Path) -> None:
    """No flow fits a level that never changes, and its rounding says nothing of a unit."""
    plant = load_plant(folder / "rig.yaml")
    run = recorded(plant, {})
    for column in range(2):
        outputs = run.outputs.clone()
        outputs[:, column] = 0.0
        assert wrong_units(plant, replace(run, outputs=outputs)) == ""


def test_flows_that_no_recording_can_tell_apart_are_no_wrong_unit(folder: Path) -> None:
    """A leaking tank at a constant level: flows by pump and by laws are proportional, the regression is singular."""
    plant = load_plant(folder / "rig.yaml")
    run = recorded(plant, {})
    constant = replace(run, inputs=0.0 * run.inputs + 5e-5, outputs=0.0 * run.outputs + 0.1)
    assert wrong_units(plant, constant) == ""


@pytest.mark.parametrize("flow", ["1 l/min", "3 l/min", "3.3 l/min"])
def test_a_steady_state_without_noise_is_no_wrong_unit(tmp_path: Path, flow: str) -> None:
    """All sums of the balance are equal but for the digits of the file, whose scatter says nothing of its error."""
    plant = build_plant(yaml.safe_load(PLANT), "plant.yaml")
    run = fdi_torch.simulate(plant, inputs={"Q": flow}, duration="600 s")
    fdi_torch.write_csv(run, tmp_path / "run.csv")
    read = fdi_torch.read_recording(tmp_path / "run.csv", plant)
    assert wrong_units(plant, read) == ""


@pytest.mark.parametrize(
    ("sensor", "written", "sentence"),
    [
        ("hA: {tank: A}", "mm", "the level hA is 10 times too large (write mm in place of cm)"),
        ("hA: {tank: A, gain: 98.1 mbar/m, offset: 5 mbar}", "mbar", "the pressure hA is 10 times too large"),
    ],
)
def test_a_wrong_unit_concerns_the_sensors_of_its_kind(
    tmp_path: Path, sensor: str, written: str, sentence: str
) -> None:
    """B is read in %, of which no unit can be wrong in this way."""
    text = PLANT.replace("hA: {tank: A}, hB: {tank: B}", f"{sensor}, hB: {{tank: B, gain: 166.7 %/m}}")
    (tmp_path / "rig.yaml").write_text(text)
    plant = load_plant(tmp_path / "rig.yaml")
    noise = {"std": {"hA": f"0.5 {written}", "hB": "0.1 %"}}
    run = fdi_torch.simulate(plant, inputs={"Q": {"steps": STEPS}}, duration="600 s", noise=noise)
    unit = "cm" if written == "mm" else "kPa"
    wrong = replace(run, outputs=run.outputs * torch.tensor([10.0, 1.0]), written={"hA": unit})
    assert wrong_units(plant, run) == ""
    assert sentence in wrong_units(plant, wrong)


@pytest.mark.parametrize("gain", [1.0, 0.9])
def test_levels_in_inches_that_the_file_calls_centimetres_are_named(folder: Path, gain: float) -> None:
    """All sensors share one factor, that of two units; a gain of each sensor would explain it as well."""
    plant = load_plant(folder / "rig.yaml")
    run = recorded(plant, {"Q.pump_gain": gain})
    wrong = replace(run, outputs=run.outputs / 2.54, written={"hA": "cm", "hB": "cm"})
    assert "the levels hA, hB are 2.54 times too small (write in in place of cm)" in wrong_units(plant, wrong)


def test_one_level_off_by_the_ratio_of_an_inch_is_not_said_to_be_in_inches(folder: Path) -> None:
    plant = load_plant(folder / "rig.yaml")
    run = recorded(plant, {})
    factors = torch.tensor([1.0 / 2.54, 1.0], dtype=torch.float64)
    wrong = replace(run, outputs=factors * run.outputs, written={"hA": "cm", "hB": "cm"})
    assert wrong_units(plant, wrong) == "" and doubtful_units(plant, wrong) == []


STEADY: dict[str, Any] = {"inputs": {"Q1": "50 cm^3/s", "Q2": "50 cm^3/s"}, "duration": "600 s"}
STEADY |= {"noise": {"std": {"h1": "1 mm", "h2": "1 mm", "h3": "1 mm"}}}


@pytest.mark.parametrize("faults", [{}, {"T1.leak": 0.3}, {"P13.plugging": 0.5}])
@pytest.mark.parametrize("start", ["equilibrium", "20 cm"])
@pytest.mark.parametrize("column", [0, 1, 2])
def test_one_level_in_a_wrong_unit_is_found_under_constant_inputs(
    faults: dict[str, float], start: str, column: int
) -> None:
    plant = load_plant("three_tank")
    run = fdi_torch.simulate(plant, faults=faults, start_levels=start, **STEADY)
    assert doubtful_units(plant, run) == []
    factors = torch.ones(3, dtype=torch.float64)
    factors[column], name = 0.1, f"h{column + 1}"
    ((columns, sentence),) = doubtful_units(plant, replace(run, outputs=factors * run.outputs, written={name: "mm"}))
    assert columns == name
    assert sentence == (
        f"by the volume balance of the tanks, the level {name} is 10 times too small (write cm in place of mm), unless "
        f"{name} does not follow the level"
    )


def test_an_unusual_level_at_rest_is_no_wrong_unit() -> None:
    """A sensor that is stuck, or off by half of the level, is no factor of ten of what the flows make it."""
    plant = load_plant("three_tank")
    run = fdi_torch.simulate(plant, start_levels="equilibrium", **STEADY)
    for factor in (0.5, 0.3):
        outputs = run.outputs * torch.tensor([factor, 1.0, 1.0])
        assert doubtful_units(plant, replace(run, outputs=outputs)) == []
    for trusted in (False, True):
        wrong = replace(run, outputs=run.outputs * torch.tensor([0.1, 1.0, 1.0]), trusted=trusted)
        assert any("h1 is 10 times too small" in warning for warning in data_warnings(wrong, plant)) is not trusted


def test_doubts_about_a_recording_come_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A column in cm that is mapped as mm, at rest: wrong by the check, and said first by train, its page and JSON."""
    monkeypatch.chdir(tmp_path)
    run = fdi_torch.simulate("three_tank", start_levels="equilibrium", **STEADY)
    fdi_torch.write_csv(run, tmp_path / "run.csv")
    text = (tmp_path / "run.csv").read_text()
    (tmp_path / "run.csv").write_text(text.replace(",h1_cm", ",first_cm", 1))
    (tmp_path / "train.yaml").write_text(
        "recordings: [{file: run.csv, columns: {h1: {column: first_cm, unit: mm}}}]\n"
        "estimate: {parameters: [T1.leak], search: {population: 8, evaluations: 40}}\n"
    )
    doubts = ["read in mm as mapped, although its header says cm", "the level h1 is 10 times too small (write cm"]
    assert main(["check", "--config", "train.yaml"]) == NOT_EXPLAINED
    assert all(doubt in capsys.readouterr().out for doubt in doubts[1:])
    assert main(["train", "--config", "train.yaml", "--json"]) != MISUSE
    said = json.loads(capsys.readouterr().out)["doubts"]
    assert len(said) == 2 and all(doubt in sentence for doubt, sentence in zip(doubts, said, strict=True))
    assert main(["train", "--config", "train.yaml"]) != MISUSE
    terminal = capsys.readouterr().out
    assert terminal.splitlines()[:4] == ["Doubts about the recording:", *(f"- {sentence}" for sentence in said), ""]
    page = fdi_torch.report("logs/train.mcap").page.read_text()
    assert all(page.index(doubt) < page.index("<svg") for doubt in doubts)
    (tmp_path / "files.yaml").write_text("recordings: [{file: run.csv, columns: {h1: {column: first_cm, unit: mm}}}]\n")
    here = ["--plant", "three_tank", "--recording", "files.yaml"]
    logs = []
    windows = ["train", "--config", "train.yaml", "--set", "estimate.windows=150 s"]
    for words in (windows, ["predict", *here], ["refit", *here]):
        assert main(words) != MISUSE
        assert capsys.readouterr().out.splitlines()[:4] == terminal.splitlines()[:4], words
        assert main([*words, "--json"]) != MISUSE
        result = json.loads(capsys.readouterr().out)
        assert result["doubts"] == said, words
        logs.append(result.get("log"))
    page = fdi_torch.report(logs[0]).page.read_text()
    assert "window" in page and all(page.index(doubt) < page.index("<table") for doubt in doubts)
    assert fdi_torch.predict("three_tank", replace(run, outputs=run.outputs * torch.tensor([0.1, 1.0, 1.0]))).doubts


def test_flows_follow_from_levels_not_from_readings(folder: Path) -> None:
    plant = load_plant(folder / "rig.yaml")
    run = recorded(plant, {})
    shifted = replace(plant, sensors=tuple(replace(sensor, offset=0.3) for sensor in plant.sensors))
    then, now = balance_along(plant, run), balance_along(shifted, replace(run, outputs=run.outputs + 0.3))
    for a, b in zip(now.tanks, then.tanks, strict=True):
        torch.testing.assert_close(a.by_flow, b.by_flow, rtol=1e-9, atol=1e-12)


def test_flows_do_not_depend_on_the_time_of_the_first_sample() -> None:
    """An onset in the plant file counts from the first sample of a recording, also of one that is cut."""
    plant = replace(load_plant("three_tank"), effects=(PlacedEffect("leak", "T1", {"size": 0.3, "onset": 300.0}),))
    run = fdi_torch.simulate(plant, inputs={"Q1": "50 cm^3/s", "Q2": "60 cm^3/s"}, duration="600 s")
    for first, moved in zip(
        balance_along(plant, run).tanks, balance_along(plant, replace(run, time=run.time + 450.0)).tanks, strict=True
    ):
        assert torch.allclose(first.by_flow, moved.by_flow)


def test_swapped_sensors_are_no_wrong_unit(folder: Path) -> None:
    plant = load_plant(folder / "rig.yaml")
    run = recorded(plant, {})
    assert wrong_units(plant, replace(run, outputs=run.outputs.flip(-1))) == ""


@pytest.mark.parametrize("effects", ["", "effects: [{effect: pump_cut_out, location: Q, parameters: {level: 59 cm}}]"])
def test_open_drains_are_no_levels_above_the_rim(folder: Path, effects: str) -> None:
    """Levels 100 times higher would explain the outflow, if the tanks could hold them; above a pump's cut-out no flow
    is left that could contradict them."""
    (folder / "rig.yaml").write_text(PLANT + effects)
    plant = load_plant(folder / "rig.yaml")
    assert wrong_units(plant, recorded(plant, {"A.leak": 1.0, "B.leak": 1.0})) == ""


def test_one_metered_tank_of_five_is_enough_to_name_a_wrong_unit() -> None:
    """The balance of one tank alone holds the pump's flow; the level of tank 4 is not measured."""
    plant = build_plant(
        {
            "tanks": {
                f"B{i}": {"area": f"{area} m^2", "height": "2 m"} for i, area in enumerate((0.8, 0.8, 0.6, 0.6, 1))
            },
            "pipes": {
                f"P{i}": {"source": f"B{i}", "target": f"B{i + 1}", "area": "10 cm^2", "discharge_coefficient": 0.62}
                for i in range(4)
            }
            | {"OUT": {"source": "B4", "area": "4.5 cm^2", "discharge_coefficient": 0.62}},
            "pumps": {"Q": {"target": "B0", "max_flow": "5000 l/h"}},
            "sensors": {f"L{i}": {"tank": f"B{i}", "gain": "50 %/m"} for i in (0, 1, 2, 4)},
            "tolerances": {"*.discharge_coefficient": "10 %"},
        },
        "plant.yaml",
    )
    flows = (3000, 4200, 2500, 3800, 3300, 4500)
    steps = [[f"{1200 * k} s", f"{flow} l/h"] for k, flow in enumerate(flows)]
    noise = {"std": dict.fromkeys(("L0", "L1", "L2", "L4"), "0.15 %")}
    run = fdi_torch.simulate(plant, inputs={"Q": {"steps": steps}}, duration="7200 s", sample_time="5 s", noise=noise)
    assert wrong_units(plant, run) == ""
    minutes = replace(run, inputs=60.0 * run.inputs, written={**run.written, "Q": "l/min"})
    assert wrong_units(plant, minutes) == (
        "units: by the volume balance of the tanks, the flows of Q are 60 times too large (write l/h in place of l/min)"
    )


def test_a_nearly_steady_level_speaks_the_more_against_a_unit_the_farther_it_is() -> None:
    """The scale of the flows does not decide which combinations of b a recording under a constant flow determines."""
    plant = build_plant(
        {
            "tanks": {"A": {"area": "43 cm^2", "height": "40 cm"}},
            "pipes": {"out": {"source": "A", "area": "0.16 cm^2", "discharge_coefficient": 1.0}},
            "pumps": {"P": {"target": "A", "max_flow": "200 ml/s"}},
            "sensors": {"h": {"tank": "A"}},
        },
        "plant.yaml",
    )
    leaking = fdi_torch.simulate(
        plant,
        inputs={"P": "40 ml/s"},
        duration="300 s",
        sample_time="0.1 s",
        faults={"A.leak": 0.3},
        noise={"std": {"h": "1 mm"}},
    )
    (tank,) = balance_along(plant, leaking).tanks
    balances = [[tank.scaled(10.0 ** (sign * k), 1.0) for k in range(8)] for sign in (-1, 1)]
    for farther in balances:
        evidence = [balance.log_evidence(0.0) for balance in farther]
        assert evidence == sorted(evidence, reverse=True)


@pytest.mark.parametrize("gain", [1.0, 0.9])
def test_a_worn_pump_between_nearly_equal_flows_is_no_wrong_unit(gain: float) -> None:
    """A pump that runs by turns, and a weir over which the level hardly moves beside its noise: what the tanks store is
    a small difference of large flows, of which some are 3 or 10 % off."""
    areas = {"wet": 6, "grit": 12, "aerator": 60, "settler": 40, "clear": 20}
    starts = {"wet": 2.0, "grit": 1.85, "aerator": 2.75, "settler": 2.65, "clear": 1.0}
    file: dict[str, Any] = {
        "tanks": {t: {"area": f"{a} m^2", "height": "4 m", "start_level": f"{starts[t]} m"} for t, a in areas.items()},
        "pumps": {"feed": {"target": "wet", "max_flow": "60 l/s"}},
        "transfers": {
            "lift": {"source": "wet", "target": "grit", "max_flow": "60 l/s"},
            "return": {"source": "settler", "target": "aerator", "max_flow": "20 l/s"},
        },
        "weirs": {
            "inlet": {"source": "grit", "target": "aerator", "crest": "1.8 m", "width": "60 cm"},
            "edge": {"source": "settler", "target": "clear", "crest": "2.6 m", "width": "1.2 m"},
        },
        "pipes": {
            "link": {"source": "aerator", "target": "settler", "area": "300 cm^2", "discharge_coefficient": 0.6},
            "out": {"source": "clear", "area": "100 cm^2", "discharge_coefficient": 0.6},
        },
        "sensors": {f"L_{t}": {"tank": t} for t in areas},
        "tolerances": {"*.discharge_coefficient": "5 %"},
    }
    plant = build_plant(file, "plant.yaml")
    file["weirs"]["edge"]["discharge_coefficient"] = 0.62
    feed = [20.0 + 14.0 * math.sin(0.03 * k) for k in range(80)]  # l/s, each for 900 s
    lift, wet = [0.0], starts["wet"]
    for k in range(2400):
        wet += (feed[k // 30] - gain * lift[-1]) * 30e-3 / areas["wet"]
        lift.append(45.0 if wet > 2.4 else 0.0 if wet < 0.9 else lift[-1])
    flows = [[f"{900 * k} s", f"{flow} l/s"] for k, flow in enumerate(feed)]
    switches = [[f"{30 * k} s", f"{flow} l/s"] for k, flow in enumerate(lift[:2400])]
    returned = [[f"{900 * k} s", f"{(4, 12, 8)[k * k % 3]} l/s"] for k in range(80)]
    run = fdi_torch.simulate(
        build_plant(file, "plant.yaml"),
        inputs={"lift": {"steps": switches}, "feed": {"steps": flows}, "return": {"steps": returned}},
        duration="72000 s",
        sample_time="30 s",
        faults={"lift.pump_gain": gain},
        noise={"std": {f"L_{t}": "2 mm" for t in areas}},
    )
    assert wrong_units(plant, run) == ""
    balance = balance_along(plant, run)
    for ratio in (1e-4, 1e-2, 1e2, 1e4):
        other_areas = torch.full((len(areas),), ratio)
        assert bool(
            (balance.scaled(other_areas, other_areas).log_evidence() < balance.log_evidence() - math.log(20.0)).all()
        )


def test_a_raised_crest_is_no_wrong_unit() -> None:
    """With levels a tenth as high, the weir of the settler would be dry: a flow less to be wrong about, but the level
    would follow the other flows far worse."""
    file = {
        "tanks": {"feed": {"area": "0.5 m^2", "height": "1.2 m"}, "clear": {"area": "0.3 m^2", "height": "1.2 m"}},
        "pipes": {
            "link": {"source": "feed", "target": "clear", "area": "1 cm^2", "discharge_coefficient": 0.6},
            "out": {"source": "clear", "area": "4 cm^2", "discharge_coefficient": 0.6},
        },
        "weirs": {"edge": {"source": "feed", "target": "clear", "crest": "0.8 m", "width": "5 cm"}},
        "transfers": {"recycle": {"source": "clear", "target": "feed", "max_flow": "1 m^3/h"}},
        "pumps": {"P": {"target": "feed", "max_flow": "5 m^3/h"}},
        "sensors": {"LI1": {"tank": "feed"}, "LI2": {"tank": "clear"}},
        "tolerances": {"*.discharge_coefficient": "5 %"},
    }
    plant = build_plant(file, "plant.yaml")
    feed = [["0 s", "3 m^3/h"], ["600 s", "4 m^3/h"], ["1500 s", "2.5 m^3/h"], ["2600 s", "3.4 m^3/h"]]
    recycle = [["0 s", "0.2 m^3/h"], ["900 s", "0.5 m^3/h"], ["2000 s", "0.1 m^3/h"]]
    run = fdi_torch.simulate(
        plant,
        inputs={"P": {"steps": feed}, "recycle": {"steps": recycle}},
        duration="3600 s",
        sample_time="5 s",
        faults={"edge.outlet_drop.drop": "-3 cm"},
        noise={"std": {"LI1": "2 mm", "LI2": "2 mm"}},
    )
    assert wrong_units(plant, run) == ""
