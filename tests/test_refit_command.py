"""`fdi refit`: fit a plant's own effects and constants, adopt them, and predict each file without it."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from fdi_torch import cli
from fdi_torch.config.plant_file import load_plant
from fdi_torch.config.plant_writer import dump_plant
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recordings.csv_writing import write_csv
from tests.test_gap import nominal_plant, recorded

GAIN = {"Q2.pump_gain.factor": 0.9}


@pytest.fixture
def rig(tmp_path: Path) -> PlantDescription:
    """A plant file with a pump's gain of 1, and recordings of a rig with another gain."""
    plant = tmp_path / "rig.yaml"
    text = dump_plant(replace(nominal_plant(), effects=()))
    plant.write_text(text + "effects:\n  - {effect: pump_gain, location: Q2, parameters: {factor: 1.0}}\n")
    for seed in (3, 5):
        write_csv(recorded(GAIN, seed, samples=200), tmp_path / f"day{seed}.csv")
    (tmp_path / "runs.yaml").write_text("recordings:\n  - {file: day3.csv}\n  - {file: day5.csv}\n")
    return load_plant(plant)


def test_a_refit_adopts_the_effect_and_predicts_each_file_by_the_other(
    here: Path, rig: PlantDescription, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["refit", "--plant", "rig.yaml", "--recording", "runs.yaml", "--adopt", "better.yaml", "--json", "--quiet"]
    assert cli.main([*words, "--leave-one-file-out"]) == cli.DONE
    shown = json.loads(capsys.readouterr().out)
    fitted = shown["fitted"]["Q2.pump_gain.factor"]
    assert abs(fitted["value"] - GAIN["Q2.pump_gain.factor"]) < 4.0 * fitted["std"]
    assert load_plant(here / "better.yaml").effects[0].parameters["factor"] == pytest.approx(
        fitted["value"], abs=0.05 * fitted["std"]
    )
    assert [Path(trial["source"]).name for trial in shown["leave_one_file_out"]] == ["day3.csv", "day5.csv"]
    for trial in shown["leave_one_file_out"]:
        assert sum(trial["refitted"].values()) < sum(trial["as_is"].values())


def test_a_hold_out_is_predicted_before_and_after_the_refit(
    here: Path, rig: PlantDescription, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["refit", "--plant", "rig.yaml", "--recording", "day3.csv", "--holdout", "day5.csv", "--quiet"]
    assert cli.main(words) == cli.DONE
    title, header, row = capsys.readouterr().out.partition("root mean square error of free runs")[2].splitlines()[:3]
    assert title == "; refitted: to the recordings above" and "h1 as is" in header and row.startswith("day5.csv ")
    assert cli.main([*words, "--json"]) == cli.DONE
    (run,) = json.loads(capsys.readouterr().out)["holdout"]
    assert Path(run["source"]).name == "day5.csv" and sum(run["refitted"].values()) < sum(run["as_is"].values())


def test_a_calibration_reports_how_far_constants_moved_and_writes_what_was_learnt_as_tolerances(
    here: Path, rig: PlantDescription, capsys: pytest.CaptureFixture[str]
) -> None:
    gain = replace(next(p for p in rig.pumps if p.name == "Q2"), gain=0.085)  # its range ends at 0.85, below 0.9
    wrong = replace(rig, effects=(), pumps=(rig.pumps[0], gain), tolerances={"Q2.gain": 1.0, "T1.area": 1e-6})
    (here / "wrong.yaml").write_text(dump_plant(wrong))
    words = ["refit", "--plant", "wrong.yaml", "--recording", "runs.yaml", "--adopt", "out.yaml", "--quiet"]
    assert cli.main(words) == cli.NOT_EXPLAINED
    shown = capsys.readouterr().out
    assert re.match(r"Unreliable: the model does not explain the recording \(residuals \d\.\d times", shown)
    assert "Q2.gain lies at the high end of its range" in shown and "next: out.yaml keeps the tolerances" in shown
    assert load_plant(here / "out.yaml").tolerances == wrong.tolerances

    right = replace(wrong, pumps=rig.pumps, tolerances={"Q2.gain": 0.03, "T1.area": 1e-6})
    (here / "wrong.yaml").write_text(dump_plant(right))
    assert cli.main([*words, "--narrow", "--replace"]) == cli.DONE
    shown = capsys.readouterr().out
    assert "constants fitted  unit" in shown and "effects" not in shown
    assert re.search(r"- Q2\.gain lies 3\.\d tolerances from its value in the plant file", shown)
    narrowed = load_plant(here / "out.yaml").tolerances
    assert 0.0 < narrowed["Q2.gain"] < 0.01 and narrowed["T1.area"] <= 1e-6
    gain_found = next(p.gain for p in load_plant(here / "out.yaml").pumps if p.name == "Q2")
    assert abs(gain_found - 0.9) < 4.0 * 0.9 * narrowed["Q2.gain"]


def test_held_values_stay(here: Path, rig: PlantDescription, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["refit", "--plant", "rig.yaml", "--recording", "day3.csv", "--hold", "*.pump_gain.*", "--json", "--quiet"]
    assert cli.main(words) == cli.NOT_EXPLAINED
    shown = json.loads(capsys.readouterr().out)
    assert "Q2.pump_gain.factor" not in shown["fitted"] and not shown["explained"] and shown["unexplained_ratio"] > 1.2
    assert cli.main([*words[:5], "--hold", "Q9.gain", "--quiet"]) == cli.MISUSE
    assert "Q9.gain" in capsys.readouterr().err


def test_who_stops_reading_loses_neither_the_adopted_plant_nor_the_exit_code(
    tmp_path: Path, rig: PlantDescription
) -> None:
    for reader, hold in (("true", ""), ("head -1", ""), ("true", "--hold '*.pump_gain.*'")):
        words = (
            f"{sys.executable} -m fdi_torch refit --plant rig.yaml --recording day3.csv --adopt out.yaml --quiet {hold}"
        )
        piped = f"{words} | {reader}; exit ${{PIPESTATUS[0]}}"
        done = subprocess.run(["bash", "-c", piped], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (cli.NOT_EXPLAINED if hold else cli.DONE, "")
        assert load_plant(tmp_path / "out.yaml").effects
        (tmp_path / "out.yaml").unlink()
