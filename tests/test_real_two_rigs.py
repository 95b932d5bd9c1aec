"""The cascaded tanks and the three tanks with a leak: real recordings, looked for beside the project."""

import math
import os
from pathlib import Path

import pytest

from fdi_torch import cli
from fdi_torch.config.loaded_recordings import named_recordings, read_recording
from fdi_torch.config.plant_file import load_plant
from fdi_torch.config.recording_config import RecordingConfig
from fdi_torch.estimate.evidence import TOLERANCE
from fdi_torch.gap.answer import Answer, adopted
from fdi_torch.gap.diagnose import Settings, diagnose, recalibrate
from fdi_torch.gap.explanation_pool import ExplanationPool
from fdi_torch.gap.free_runs.prediction import predict
from fdi_torch.gap.free_runs.refit import refit
from fdi_torch.gap.marginal_likelihood import evidence_under, with_estimated_noise
from fdi_torch.gap.problem import DEFAULT_SETTINGS, problem_of
from fdi_torch.recording import Recording

ROOT = Path(__file__).parents[1]
DATA = Path(os.environ.get("FDI_TORCH_DATA") or ROOT.parent / "shared" / "data")
CASCADE = DATA / "cascaded_tanks" / "cascaded_tanks_estimation.csv"
LEAK = DATA / "three_tank_leak" / "three_tank_leak_1Hz.csv"
REAL = ROOT / "configs" / "real"

pytestmark = [pytest.mark.data, pytest.mark.skipif(not DATA.is_dir(), reason="no real recordings here")]
QUARTERS = [(0, 1020), (1024, 2044), (2048, 3068), (3072, 4092)]  # s


def cascade(**stretch: object) -> Recording:
    plant = load_plant(REAL / "cascaded_tanks_found.yaml")
    return read_recording(RecordingConfig.model_validate({"file": str(CASCADE), **stretch}), plant, ROOT)


def test_the_cascade_as_found_runs_freely_along_its_record() -> None:
    found = predict(load_plant(REAL / "cascaded_tanks_found.yaml"), cascade())
    assert found.settled
    assert found.rmse["level"] < 0.12  # V; 0.57 V without what was found


@pytest.mark.slow
@pytest.mark.parametrize("quarter", [0, 3])
def test_the_cascade_predicts_a_quarter_that_its_numbers_never_saw(quarter: int) -> None:
    first, last = QUARTERS[quarter]
    rest = {"start": f"{last + 4} s"} if quarter == 0 else {"stop": f"{first - 4} s"}
    fitted = refit(load_plant(REAL / "cascaded_tanks_found.yaml"), cascade(**rest)).plant
    held_out = predict(fitted, cascade(start=f"{first} s", stop=f"{last} s"))
    assert held_out.rmse["level"] < 0.25


def test_the_noise_of_the_recalibrated_cascade_is_the_most_likely_one_with_its_fit() -> None:
    """Linearised about the free run, the plant is another one after a refit, in which the fit may be less likely."""
    data = problem_of(load_plant(REAL / "cascaded_tanks_nominal.yaml"), [cascade()], [], DEFAULT_SETTINGS).data
    fitter, null, _ = recalibrate(data)
    pool = ExplanationPool(fitter, null, 100)
    base = pool.evaluate(null)
    own, _ = with_estimated_noise(fitter, base.fit, base.noise)
    # A descent ends, under its noise, where this one has far to go: a Newton decrement of 5.5 nats.
    assert not base.fit.converged and not base.fitter.converged(base.fit)
    assert evidence_under(own, base.fit, pool.choices) < base.log_evidence + TOLERANCE


@pytest.mark.slow
def test_the_clip_of_the_cascade_is_found_and_its_overflow_is_an_explanation() -> None:
    """Which explanation is likeliest depends on rounding, since no fit converges; the overflow is not always in it."""
    plant = load_plant(REAL / "cascaded_tanks_nominal.yaml")
    answer = diagnose(plant, cascade(), settings=Settings(library=("all",), named_only=True))
    causes = {(c.effect, c.location): c for c in answer.causes}
    assert causes["sensor_saturation", "level"].parameters["limit"].value == 10.0
    assert any(("overflow", "upper") in explanation.causes for explanation in answer.posterior)
    assert answer.verdict == "ambiguous" and not answer.converged, "no fit of this rig has converged"


@pytest.fixture(scope="module")
def leak_rig() -> tuple[Answer, Answer]:
    """The diagnoses of the calm recordings, and of the recording with a leak by the plant that the first one adopts."""
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("FDI_TORCH_DATA", str(DATA))
        plant = load_plant(REAL / "three_tank_leak_nominal.yaml")
        calm = named_recordings(str(REAL / "three_tank_leak_calm.yaml"), plant, DATA)
        first = diagnose(plant, calm, settings=Settings(most=6))
        whole = read_recording(RecordingConfig(file=str(LEAK)), plant, ROOT)
        return first, diagnose(adopted(plant, first, constants=True), whole)


@pytest.mark.slow
def test_offsets_of_tanks_that_start_empty_are_adopted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The fit ends 0.11 standard errors before its minimum: of a start level at zero, steps are refused."""
    monkeypatch.setenv("FDI_TORCH_DATA", str(DATA))
    step = tmp_path / "step1.yaml"
    words = ["gap", "--plant", str(REAL / "three_tank_leak_nominal.yaml"), "--library", "sensor_bias"]
    words += ["--recording", str(REAL / "three_tank_leak_calm.yaml"), "--adopt", str(step), "--with-constants"]
    assert cli.main([*words, "--quiet", "--out", str(tmp_path)]) == cli.DONE
    adopted_biases = [p.location for p in load_plant(step).effects if p.effect == "sensor_bias"]
    assert set(adopted_biases) == {"p1", "p2", "p3"}


@pytest.mark.slow
def test_offsets_and_rounding_of_the_leak_rig_are_named_and_its_leak_is_located(
    leak_rig: tuple[Answer, Answer],
) -> None:
    first, second = leak_rig
    offsets = {c.location: c.parameters["bias"] for c in first.causes if c.effect == "sensor_bias"}
    assert set(offsets) == {"p1", "p2", "p3"}
    # At rest and empty they read 0.156, 0.103 and 0.161 V, in steps of 10.2 mV, whose rounding has a variance too.
    for name, reading in (("p1", 0.156), ("p2", 0.103), ("p3", 0.161)):
        std = math.hypot(offsets[name].std, 0.0102 / 12**0.5)
        assert std < 0.01 and abs(offsets[name].value - reading) < 3.0 * std
    causes = {(c.effect, c.location): c for c in second.causes}
    for sensor in ("p1", "p2", "p3"):
        assert causes["sensor_quantization", sensor].parameters["step"].value == pytest.approx(0.0102, rel=0.01)
    assert second.where[0][0] == "T2" and second.where[0][1] > 0.95
