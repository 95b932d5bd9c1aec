"""fdi challenge from sealing to scores, on the one kind that is quick to diagnose."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import pytest

from fdi_torch.blind import cases
from fdi_torch.cli import DONE, MISUSE, main
from fdi_torch.config.plant_file import load_plant


@pytest.mark.slow
def test_a_sound_rig_is_called_sound(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["challenge", "--cases", "1", "--kinds", "null", "--out", str(tmp_path), "--json", "--quiet"]
    assert main([*words, "--plant", "three_tank"]) == DONE
    scores = json.loads(capsys.readouterr().out)["tables"]["three_tank"]
    assert scores["fdi"]["strata"]["null"]["right"]["share"] == 1.0
    assert set(scores) == {"always_null", "random", "fdi"}
    key = json.loads((tmp_path / "manifest.jsonl").read_text())["key"]
    with gzip.open(tmp_path / "cases" / "case0001_recording.csv.gz", "rt") as recording:
        assert recording.readline() == f"# SHA-256 of the sealed key: {key}\n"
    again = tmp_path / "joined"
    assert main(["challenge", "--join", str(tmp_path), "--out", str(again)]) == DONE
    assert (again / "scores.md").read_text() == (tmp_path / "scores.md").read_text()
    assert "false alarm" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--cases", "0"], "--cases: expected at least one case, got 0"),
        (["--rig", "three_tank", "--plant", "three_tank"], "expected --rig or --plant, got both"),
        (["--tanks", "3..5"], "--tanks: expected --plant network with it"),
        (["--plant", "network", "--tanks", "3-5"], "--tanks: expected a number or a range, got '3-5'"),
        (["--join", "here", "--seed", "3"], "--join: expected folders only, got also --seed"),
    ],
)
def test_misuse_is_said_in_a_sentence(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["challenge", *words]) == MISUSE
    assert said in capsys.readouterr().err


@pytest.mark.slow
def test_cases_on_networks_are_made_without_an_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cases, "STEP", 0.5)
    words = ["challenge", "--plant", "network", "--tanks", "3", "--cases", "1", "--kinds", "hidden"]
    assert main([*words, "--minutes", "0", "--out", str(tmp_path), "--quiet"]) == DONE
    plant = load_plant(tmp_path / "cases" / "case0001_plant.yaml")
    assert len(plant.tanks) == 3 and len(plant.sensors) == 2
