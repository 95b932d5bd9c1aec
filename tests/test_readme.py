"""The examples of the README do what it says."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from fdi_torch.cli import COMMANDS, DONE, main
from fdi_torch.config.run_file import load_run

README = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.S)


def test_python_examples_run() -> None:
    names: dict[str, object] = {}
    for code in blocks("python"):
        exec(code, names)
    assert tuple(names["readings"].shape) == (1000, 601, 3)  # type: ignore[attr-defined]
    assert tuple(names["jacobian"].shape) == (10, 601, 3, 2)  # type: ignore[attr-defined]


def test_every_command_is_in_the_table() -> None:
    listed = re.findall(r"^\| `(\w+)` \|", README, flags=re.M)
    assert listed == list(COMMANDS)


def test_own_recording_gives_what_is_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    rig, own, watched = blocks("yaml")
    assert yaml.safe_load(rig)["simulate"]["faults"] == {"T1.leak": 0.1, "P32.plugging": 0.4}
    Path("rig.yaml").write_text(rig)
    Path("own.yaml").write_text(own)
    assert main(["simulate", "--config", "rig.yaml", "--out", ".", "--quiet"]) == DONE
    assert main(["check", "rig.csv", "--plant", "three_tank", "--quiet"]) == DONE
    assert main(["train", "--config", "own.yaml", "--quiet"]) == DONE
    assert main(["report", "logs/own.mcap", "--quiet"]) == DONE
    assert main(["gap", "--plant", "three_tank", "--recording", "rig.csv", "--quiet"]) == DONE
    leaking = re.search(r"--set '(simulate\.faults=.*?)' --set output.name=leaking", README)
    assert leaking is not None
    words = ["--set", leaking[1], "--set", "output.name=leaking", "--out", ".", "--quiet"]
    assert main(["simulate", "--config", "rig.yaml", *words]) == DONE
    Path("watch.yaml").write_text(watched)
    assert main(["monitor", "--config", "watch.yaml", "--quiet"]) == DONE
    shown = capsys.readouterr().out
    for line in re.findall(r"^ +\d+\.0 s  .*$", README, flags=re.M):
        assert line in shown
    assert "logs/own.mcap: 2 faults: leak at T1 (size 0.0997" in shown and "page: logs/own.html" in shown
    assert "The gap comes from leak at T1 and plugging at P32, probability 99.8 %" in shown
    for line in ("1201 samples, 1200 s: rig.csv", "nothing odd was found", "12.2 cm^3/s", "29.4 cm^3/s"):
        assert line in shown and line in README
    assert load_run("own.yaml").plant.name == "three_tank"
