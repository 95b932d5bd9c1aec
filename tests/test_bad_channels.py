"""Swapped channels, wrong units, stuck sensors and clock errors are reported or refused, and never diagnosed as a
fault.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from torch import Tensor

from fdi_torch.config.loaded_recordings import read_recording
from fdi_torch.config.recording_config import config_of
from fdi_torch.gap.candidate import Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.diagnose import Settings, diagnose
from fdi_torch.gap.preprocess.acquisition import examined, usable
from fdi_torch.gap.preprocess.blockwise_likelihood import (
    ROUNDS,
    blocked_recording,
    blockwise_fit,
    noise_of,
)
from fdi_torch.gap.preprocess.corrected_fit import first_order_log_likelihood
from fdi_torch.gap.problem import DEFAULT_SETTINGS, problem_of
from fdi_torch.gap.trajectory_problem import GIVE_UP_DEFICIT
from fdi_torch.jobs.logged_monitor import usable_part
from fdi_torch.recording import Recording
from fdi_torch.recordings.csv_writing import write_csv
from fdi_torch.recordings.repeated_readings import Scatter, scatter, stuck_runs
from tests.test_gap import SMALL, noise, nominal_plant, recorded


@cache
def sound() -> Recording:
    """Of a rig whose constants are within their tolerances, read to a hundredth of a millimetre."""
    run = recorded({"P13.discharge_coefficient": 0.615}, 11, samples=2000)
    return replace(run, outputs=(run.outputs / 1e-5).round() * 1e-5)


def with_channel(recording: Recording, column: int, values: Tensor) -> Recording:
    outputs = recording.outputs.clone()
    outputs[:, column] = values
    return replace(recording, outputs=outputs)


def from_sample(recording: Recording, column: int, first: int, value: float | None = None) -> Recording:
    values = recording.outputs[:, column].clone()
    values[first:] = values[first] if value is None else value
    return with_channel(recording, column, values)


def test_readings_that_repeat_longer_than_noise_explains_are_held() -> None:
    x = 0.3 + 0.1 * torch.sin(torch.arange(2000, dtype=torch.float64) / 90) + noise(2000, 0.0, 0.001, 1)[:, 0]
    assert stuck_runs(x) == []
    stuck = x.clone()
    stuck[400:430], stuck[1000:] = stuck[400], stuck[1000]
    assert stuck_runs(stuck) == [(400, 430), (1000, 2000)]
    fine = (stuck / 1e-4).round() * 1e-4
    assert stuck_runs(fine)[-1] == (1000, 2000)


@pytest.mark.parametrize("step", [3e-3, 1e-2, 3e-2])
@pytest.mark.parametrize("slow", [90.0, 2000.0])
def test_a_quantized_channel_is_not_held(step: float, slow: float) -> None:
    for seed in range(5):
        level = 0.3 + 0.1 * torch.sin(torch.arange(4000, dtype=torch.float64) / slow)
        x = level + noise(4000, 0.0, 0.001, seed)[:, 0]
        assert stuck_runs((x / step).round() * step) == []


def test_a_run_is_called_too_long_in_one_recording_of_a_thousand() -> None:
    """Noise of 1 in steps of 0.8: every third reading repeats the last one."""
    generator = torch.Generator().manual_seed(3)
    calls = 0
    for _ in range(300):
        x = torch.randn(500, generator=generator, dtype=torch.float64)
        calls += bool(stuck_runs((x / 0.8).round() * 0.8))
    assert calls <= 3


def test_a_sensor_that_never_moves_is_compared_with_its_neighbours_noise() -> None:
    still = torch.full((500,), 0.3, dtype=torch.float64)
    assert stuck_runs(still) == []
    assert stuck_runs(still, Scatter(1e-3, 1e-5)) == [(0, 500)]
    assert stuck_runs(still, Scatter(1e-5, 1e-2)) == []
    told = scatter((noise(5000, 0.0, 1e-3, 2)[:, 0] / 5e-4).round() * 5e-4)
    assert told.noise == pytest.approx(1e-3, rel=0.2) and told.step == pytest.approx(5e-4)


EACH_SENSOR = [(0, None, 0), (1, None, 800), (2, 0.0, 800), pytest.param(1, 0.0, 0, marks=pytest.mark.slow)]


def test_the_onset_of_a_stuck_sensor_counts_from_the_first_sample_of_a_part_of_a_recording() -> None:
    whole = from_sample(sound(), 1, 800, None)
    for run in (whole, whole.window(float(whole.time[200]))):
        first = 800 - len(whole) + len(run)
        (known,) = problem_of(nominal_plant(), [run], [], DEFAULT_SETTINGS).known_effects
        assert known.values is not None
        assert known.values["onset"] == pytest.approx(float(run.time[first] - run.time[0]))


@pytest.mark.parametrize(("column", "value", "first"), EACH_SENSOR)
def test_a_stuck_sensor_is_masked_and_reported(column: int, value: float | None, first: int) -> None:
    found = examined(nominal_plant(), from_sample(sound(), column, first, value))
    assert [(s.sensor.name, s.first, s.for_good) for s in found.stuck] == [(f"h{column + 1}", first, True)]
    assert found.fault is None
    counted = found.recording.mask.sum(dim=0).tolist()
    assert counted[column] == first
    assert [n for c, n in enumerate(counted) if c != column] == [2000, 2000]
    assert f"h{column + 1} is stuck at" in found.recording.notes[-1]


@pytest.mark.parametrize(
    ("factor", "said"),
    [
        (0.1, "its unit seems wrong: its values are 10 times too small"),
        pytest.param(1e-3, "its unit seems wrong: its values are 1000 times too small", marks=pytest.mark.slow),
        pytest.param(
            10.0, "by the volume balance of the tanks, the level h3 is 10 times too large", marks=pytest.mark.slow
        ),
    ],
)
def test_a_wrong_unit_is_refused(factor: float, said: str) -> None:
    run = sound()
    with pytest.raises(ValueError, match=f"h3: {said}"):
        usable(nominal_plant(), with_channel(run, 2, factor * run.outputs[:, 2]))


def test_a_command_in_the_wrong_unit_is_refused() -> None:
    run = sound()
    inputs = run.inputs * torch.tensor([1.0, 0.1], dtype=torch.float64)
    with pytest.raises(ValueError, match=r"Q2: its unit seems wrong: .* 10 times too small; .* or correct its gain in"):
        usable(nominal_plant(), replace(run, inputs=inputs))


def test_swapped_sensors_are_refused() -> None:
    run = sound()
    with pytest.raises(ValueError, match="h1 and h3 seem to be swapped"):
        usable(nominal_plant(), replace(run, outputs=run.outputs[:, [2, 1, 0]]))


def test_swapped_commands_are_refused() -> None:
    run = sound()
    with pytest.raises(ValueError, match="Q1 and Q2 seem to be swapped"):
        usable(nominal_plant(), replace(run, inputs=run.inputs.flip(1)))


def test_a_correction_that_masks_readings_is_compared_to_first_order() -> None:
    """A sensor without readings has no likelihood; the others are as they were."""
    plant, run = nominal_plant(), sound()
    mask = run.mask.clone()
    mask[:, 0] = False
    fit = blockwise_fit(blocked_recording(plant, run, noise_of(plant, run)))
    masked = first_order_log_likelihood(fit, blocked_recording(plant, replace(run, mask=mask), noise_of(plant, run)))
    others = -0.5 * float((fit.means * torch.log(fit.variance))[1:].sum()) - 0.5 * fit.prior_chi_square
    assert masked == pytest.approx(others, abs=1.0)


def test_a_swap_is_compared_to_first_order() -> None:
    plant, run = nominal_plant(), sound()
    swapped = replace(run, inputs=run.inputs.flip(1))
    right, wrong = (blocked_recording(plant, r, noise_of(plant, r)) for r in (run, swapped))
    fit, fit_to_swapped = blockwise_fit(right), blockwise_fit(wrong)
    # Where the constants are already the best, a further step changes nothing.
    assert first_order_log_likelihood(fit, right) == pytest.approx(fit.log_likelihood, abs=0.1)
    gain = fit.log_likelihood - fit_to_swapped.log_likelihood
    assert first_order_log_likelihood(fit_to_swapped, right) - fit_to_swapped.log_likelihood > 0.5 * gain
    assert first_order_log_likelihood(fit, wrong) - fit.log_likelihood < -0.5 * gain


def late(run: Recording, seconds: int) -> Recording:
    """All readings so many samples late, or early where that is below 0."""
    first, last = max(seconds, 0), len(run) + min(seconds, 0)
    moved = replace(run.stretch(first, last), outputs=run.outputs[first - seconds : last - seconds], ran=frozenset())
    return replace(moved, mask=torch.isfinite(moved.outputs))


@pytest.mark.parametrize("seconds", [40, -20, pytest.param(-200, marks=pytest.mark.slow)])
def test_clock_offsets_are_refused(seconds: int) -> None:
    when = "late" if seconds > 0 else "early"
    with pytest.raises(ValueError, match=rf"the readings: time stamps are {abs(seconds)}(\.\d)? s too {when} "):
        usable(nominal_plant(), late(sound(), seconds))


def second_sensor_late(run: Recording, seconds: int) -> Recording:
    """The readings of the second sensor so many samples late, or early where that is below 0."""
    moved = with_channel(run, 1, torch.roll(run.outputs[:, 1], seconds))
    return moved.stretch(max(seconds, 0), len(run) + min(seconds, 0))


@pytest.mark.parametrize("late_by", [-60, 60])
def test_the_correction_that_is_named_mends_the_clock(late_by: int, tmp_path: Path) -> None:
    """The channel in a file of its own, with the shift of the message."""
    plant, moved = nominal_plant(), second_sensor_late(sound(), late_by)
    file = write_csv(moved, tmp_path / "run.csv")
    whole = read_recording(config_of(file), plant, tmp_path)
    fault = examined(plant, whole).fault
    assert fault is not None
    fix = fault.text.partition("also: ")[2].replace("...", file.name)
    mended = read_recording(config_of({"file": file.name, "also": yaml.safe_load(fix)}), plant, tmp_path)
    assert [examined(plant, part).fault for part in mended.known_segments()] == [None]


@pytest.mark.parametrize(("late_by", "when"), [(-60, "early"), (60, "late")])
def test_only_the_gap_diagnosis_accepts_a_sensor_that_leads_or_lags_the_others(late_by: int, when: str) -> None:
    moved = second_sensor_late(sound(), late_by)
    with pytest.raises(ValueError, match=rf"h2: time stamps are \S+ s too {when} compared with the other channels"):
        usable(nominal_plant(), moved)
    remarks = problem_of(nominal_plant(), [moved], [], DEFAULT_SETTINGS).remarks
    assert [f"too {when}" in remark for remark in remarks] == [True]


def test_random_readings_are_refused() -> None:
    run = sound()
    random = torch.rand(2000, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    with pytest.raises(ValueError, match="h1: its readings do not follow the level of T1"):
        usable(nominal_plant(), with_channel(run, 0, random))


def test_a_trusted_recording_is_not_refused() -> None:
    run = sound()
    wrong = with_channel(run, 2, 10.0 * run.outputs[:, 2])
    assert usable(nominal_plant(), replace(wrong, trusted=True)).fault is None


FAULTS = [
    {"Q1.pump_gain.factor": 0.3},
    {"h2.sensor_gain.factor": 0.3},
    {"h2.sensor_bias.bias": 0.2},
    {"Q1.pump_delay.delay": 40.0},
    {"h1.sensor_delay.delay": 40.0},
    {"Q1.pump_lag.time_constant": 30.0, "Q2.pump_lag.time_constant": 30.0},
    {"T2.leak.size": 0.9, "P13.plugging.size": 0.7},
]


@pytest.mark.parametrize("values", FAULTS, ids=lambda v: "+".join(v))
def test_a_large_plant_fault_is_no_recording_fault(values: dict[str, float]) -> None:
    found = examined(nominal_plant(), recorded(values, 5, samples=2000))
    assert found.fault is None and not found.stuck


def test_a_stuck_sensor_is_the_cause_and_hides_no_other() -> None:
    library = Settings((*SMALL, "sensor_stuck"))
    answer = diagnose(nominal_plant(), from_sample(sound().stretch(0, 1000), 0, 350), settings=library)
    assert (answer.verdict, [(c.effect, c.location) for c in answer.causes]) == ("named", [("sensor_stuck", "h1")])
    assert answer.causes[0].parameters["onset"].value == 350.0
    leaking = recorded({"T1.leak.size": 0.1}, 51, samples=1000)
    whole = diagnose(nominal_plant(), from_sample(leaking, 1, 0), settings=library)
    assert {(c.effect, c.location) for c in whole.causes} == {("sensor_stuck", "h2"), ("leak", "T1")}
    assert whole.verdict == "named"


def test_a_monitor_learns_of_no_part_in_which_a_sensor_is_stuck() -> None:
    with pytest.raises(
        ValueError, match=r"fault-free part in which the readings of every sensor vary, but h1 is stuck at"
    ):
        usable_part(nominal_plant(), from_sample(sound(), 0, 700))
    assert len(usable_part(nominal_plant(), sound())) == 2000


def test_a_sensor_that_is_stuck_for_a_while_is_unknown() -> None:
    run = sound().stretch(0, 1000)
    values = run.outputs[:, 1].clone()
    values[250:450] = values[250]
    answer = diagnose(nominal_plant(), with_channel(run, 1, values), settings=Settings(SMALL))
    assert answer.verdict == "unknown" and answer.where[0] == ("h2", 1.0)


@pytest.mark.slow
def test_a_recording_without_a_sensor_that_reads_is_refused() -> None:
    run = replace(sound(), outputs=torch.full((2000, 3), 0.3, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"expected a sensor whose readings vary"):
        diagnose(nominal_plant(), run, settings=Settings(SMALL))


def test_a_rival_that_lags_far_behind_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    plant, run = nominal_plant(), sound()
    blocked, fits = blocked_recording(plant, run, noise_of(plant, run)), 0
    fit = Fitter.fit

    def counted(*arguments: Any, **options: Any) -> Fit:
        nonlocal fits
        fits += 1
        return fit(*arguments, **options)

    monkeypatch.setattr(Fitter, "fit", counted)
    base = blockwise_fit(blocked)
    assert fits == ROUNDS
    blockwise_fit(blocked, base=base, target=base.log_likelihood + GIVE_UP_DEFICIT)
    assert fits == ROUNDS + 1
