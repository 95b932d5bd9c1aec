"""The DTS200 rig: what its recordings say, by name and place."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from fdi_torch.cli import main
from fdi_torch.config.plant import load_plant
from fdi_torch.config.recordings import named_recordings
from fdi_torch.gap.answer import Answer
from fdi_torch.gap.diagnose import Settings, diagnose
from fdi_torch.monitor.rehearsal.scoring import score
from fdi_torch.recording import Recording

pytestmark = pytest.mark.data
ROOT = Path(__file__).resolve().parents[1]
RUNS = ROOT / "configs" / "real" / "dts200_runs.yaml"


@pytest.fixture
def runs(real_data: Path, monkeypatch: pytest.MonkeyPatch) -> list[Recording]:
    monkeypatch.setenv("FDI_TORCH_DATA", str(real_data))
    return named_recordings(str(RUNS), load_plant("dts200"), ROOT)


def names(answer: Answer) -> set[tuple[str, str]]:
    return {(c.effect, c.location) for c in answer.causes}


@pytest.mark.slow
def test_pumps_deliver_less_than_asked_at_small_commands_and_that_of_r_more_at_large_ones(
    runs: list[Recording],
) -> None:
    recordings = [r for r in runs if "exp9" in r.source] + [r.window(0.0, 355.0) for r in runs if "exp5" in r.source]
    library = ("pump_gain", "pump_dead_zone", "pump_curve", "sensor_bias")
    settings = Settings(library, step=2.0, most=6, named_only=True)
    plant = load_plant("dts200")
    steady = replace(plant, tolerances=plant.tolerances | {"qL.gain": 0.01, "qR.gain": 0.01})
    answer = diagnose(steady, recordings, settings=settings)
    assert answer.verdict == "named"
    assert names(answer) == {("pump_curve", "qL"), ("pump_curve", "qR"), ("pump_gain", "qR")}
    gain = next(c for c in answer.causes if c.effect == "pump_gain").parameters["factor"]
    # Pulses of 4 s at 100 cm^3/s deliver 1.08 to 1.15 of it into R.
    assert 1.08 < gain.value < 1.16 and gain.std < 0.02
    bends = {c.location: c.parameters["bend"].value for c in answer.causes if c.effect == "pump_curve"}
    assert -0.35 < bends["qL"] < bends["qR"] < -0.1


@pytest.mark.parametrize("plant", ["dts200_exp5", "dts200_exp5_adopted"])
def test_drains_that_open_and_close_are_one_event_each(
    plant: str, real_data: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first cycle: positions of the valves, which the monitor does not see, are the truth."""
    monkeypatch.setenv("FDI_TORCH_DATA", str(real_data))
    config, stop = str(ROOT / "configs" / "monitor" / f"{plant}.yaml"), 860.0
    words = ["monitor", "--config", config, "--json", "--quiet", "--out", str(tmp_path)]
    assert main([*words, "--set", f"recording.stop={stop:g} s"]) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    recording = real_data / "dts200" / "exp5_pump_staircase_drain__2194.csv"
    opened, closed = (moments(recording, "vLD_pct", 50.0, rising, stop) for rising in (True, False))
    found = score([e["time"] for e in events if e["kind"] == "alarm"], opened + closed, early=5.0)
    assert not found.misses and len(found.false) <= 3, found
    first = next(e for e in events if e["kind"] == "isolated" and e["time"] > opened[0])
    assert set(first["faults"]) == {"L.leak.size", "M.leak.size", "R.leak.size", "LM.valve_leak.size"}
    assert abs(first["onset"] - opened[0]) < 1.0
    assert any(e["kind"] == "recovered" and abs(e["onset"] - closed[0]) < 10.0 for e in events)


def moments(file: Path, column: str, level: float, rising: bool, stop: float) -> list[float]:
    """When a recorded column passes a level, s."""
    with file.open() as lines:
        rows = [(float(row["t_s"]), float(row[column])) for row in csv.DictReader(lines) if float(row["t_s"]) < stop]
    return [
        t
        for (_, before), (t, after) in pairwise(rows)
        if (before < level <= after if rising else before >= level > after)
    ]
