"""The DTS200 rig: what its recordings say, by name and place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from fdi_torch.config.plant import load_plant
from fdi_torch.config.recordings import named_recordings
from fdi_torch.gap.answer import Answer
from fdi_torch.gap.diagnose import Settings, diagnose
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
