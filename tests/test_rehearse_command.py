"""`fdi rehearse`: pieces, resumed where they stopped, and their tables."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fdi_torch.cli import MISUSE, main
from fdi_torch.config.rehearsal_file import load_rehearsal
from fdi_torch.jobs.study import rehearse
from fdi_torch.logbook import read_run
from fdi_torch.monitor.monte_carlo.detection_plan import mean_time

FALSE_ALARMS = """
inputs: [50 cm^3/s, 50 cm^3/s]
false_alarms: {noises: {white: {}}, runs: 2, lasts: 200 s, calibrations: 2}
"""


def test_a_stopped_rehearsal_is_resumed_and_says_the_same(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "alarms.yaml"
    file.write_text(FALSE_ALARMS)
    words = ["rehearse", "--config", str(file), "--quiet", "--json"]
    assert main([*words, "--out", str(tmp_path / "whole")]) == 0
    whole = json.loads(capsys.readouterr().out)
    [table] = whole["tables"]
    assert [row["detector"] for row in table["rows"]] == ["fixed", "cusum"] and table["rows"][0]["calibrations"] == "2"
    assert whole["computed"] == 2

    def stop(share: float, text: str) -> None:
        if share > 0.0:
            raise KeyboardInterrupt

    parts = load_rehearsal(file, [f"output.folder={tmp_path / 'parts'}"])
    with pytest.raises(KeyboardInterrupt):
        rehearse(parts, tell=stop)
    assert main([*words, "--out", str(tmp_path / "parts"), "--resume"]) == 0
    parted = json.loads(capsys.readouterr().out)
    assert parted["computed"] == 1 and parted["tables"] == whole["tables"]
    assert read_run(parted["log"]).metadata["fdi_torch.status"]["status"] == "completed"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("inputs: [50 cm^3/s]\nfaults_found: {faults: [T1.leak]}", "expected 2 (Q1, Q2), got 1"),
        ("inputs: [50 cm^3/s, 50 cm^3/s]", "expected false_alarms, faults_found or naming, got none"),
        ("inputs: []\nnaming: {faults: []}", "naming.faults"),
    ],
)
def test_misuse_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, said: str) -> None:
    file = tmp_path / "wrong.yaml"
    file.write_text(text)
    assert main(["rehearse", "--config", str(file), "--quiet"]) == MISUSE
    assert said in capsys.readouterr().err


def test_times_between_false_alarms_come_with_the_spread_of_calibrations() -> None:
    mean, low, high = mean_time([90] * 8, 20000.0, 90.0)
    assert mean == 20000.0 and low == pytest.approx(20000.0 / (1.0 + 1.96 / 720**0.5)) and high > mean
    assert mean_time([60, 120] * 4, 20000.0, 90.0)[1] < low
    # Two values 20 apart: 12.706 standard errors of 10 (Student's t with one degree of freedom).
    assert mean_time([990, 1010], 20000.0, 1000.0)[1] == pytest.approx(20000.0 / 1.12706, rel=1e-5)


@pytest.mark.slow
def test_all_rehearsals_make_their_tables(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = {
        "false_alarms": ["runs=2", "calibrations=1", "lasts=400 s", "noises={white: {}}"],
        "faults_found": ["runs=2", "named=2", "sizes=[0.1]", "lasts=500 s"],
        "naming": ["runs=2", "loops=[open]", "faults=[T1.leak, h2.sensor_bias]", "lasts=600 s"],
    }
    for name, changes in small.items():
        sets = [word for change in changes for word in ("--set", f"{name}.{change}")]
        config = str(Path(__file__).parents[1] / "configs" / "rehearsals" / f"{name}.yaml")
        assert main(["rehearse", "--config", config, "--quiet", "--json", "--out", str(tmp_path), *sets]) == 0
        [table] = json.loads(capsys.readouterr().out)["tables"]
        assert table["rows"], name
        if name == "faults_found":
            assert all(row["missed"] == "0" and row["named right"].startswith("2 of 2") for row in table["rows"])
