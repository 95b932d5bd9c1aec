"""Units that are wrong for all areas, flows or levels: every command names them before it computes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml

import fdi_torch
from fdi_torch.cli import MISUSE, NOT_EXPLAINED, main
from fdi_torch.config.plant_file import build_plant, load_plant
from fdi_torch.plant.description import PlantDescription
from fdi_torch.quantities import display_in
from fdi_torch.recordings.plant_units import volumes_along, wrong_units

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


@pytest.mark.parametrize(
    "command",
    [
        ["gap", "--plant", "rig.yaml", "--recording", "run.csv"],
        ["refit", "--plant", "rig.yaml", "--recording", "run.csv"],
        ["train", "--config", "train.yaml"],
        ["monitor", "--config", "watch.yaml"],
    ],
    ids=lambda words: words[0],
)
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


def test_a_recording_without_metered_flows_or_too_short_says_nothing(folder: Path) -> None:
    run = recorded(load_plant(folder / "rig.yaml"), {})
    (folder / "large.yaml").write_text(PLANT.replace("200 cm^2", "200 m^2").replace("150 cm^2", "150 m^2"))
    large = load_plant(folder / "large.yaml")
    display_in(large.units)
    assert wrong_units(large, run.stretch(0, 32)) == "" != wrong_units(large, run)
    unmetered = replace(run, inputs=0.0 * run.inputs)
    assert wrong_units(large, unmetered) == ""
    assert wrong_units(large, replace(unmetered, outputs=0.0 * run.outputs)) == ""


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


def test_flows_follow_from_levels_not_from_readings(folder: Path) -> None:
    plant = load_plant(folder / "rig.yaml")
    run = recorded(plant, {})
    shifted = replace(plant, sensors=tuple(replace(sensor, offset=0.3) for sensor in plant.sensors))
    then, now = volumes_along(plant, run), volumes_along(shifted, replace(run, outputs=run.outputs + 0.3))
    torch.testing.assert_close(now.by_laws, then.by_laws, rtol=1e-9, atol=0.0)


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
    volumes = volumes_along(plant, leaking)
    balances = [[replace(volumes, metered=10.0 ** (sign * k) * volumes.metered) for k in range(8)] for sign in (-1, 1)]
    for farther in balances:
        evidence = [float(balance.log_evidence()) for balance in farther]
        assert evidence == sorted(evidence, reverse=True)
