"""fdi challenge from sealing to scores, on the one kind that is quick to diagnose."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fdi_torch.cli import DONE, main


@pytest.mark.slow
def test_a_sound_rig_is_called_sound(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["challenge", "--cases", "1", "--kinds", "null", "--out", str(tmp_path), "--json", "--quiet"]
    assert main(words) == DONE
    scores = json.loads(capsys.readouterr().out)["scores"]
    assert scores["fdi"]["null"]["right"]["share"] == 1.0
    assert (tmp_path / "key.jsonl").is_file()
