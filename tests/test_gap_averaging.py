"""Readings that are denser than the integration steps count by their means: work and memory do not grow with them."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from fdi_torch.estimate.fitting import set_up
from fdi_torch.estimate.levenberg_marquardt import levenberg_marquardt
from fdi_torch.estimate.refinement import information_std
from fdi_torch.gap.dataset import at_recorded_times, data_set_of
from fdi_torch.gap.diagnose import Settings, diagnose, recalibrate
from fdi_torch.gap.problem import LONGEST_STEP, MANY_STEPS, SHORTEST_STEP, checked_data_set, problem_of
from fdi_torch.plant.scales import time_scale
from fdi_torch.recording import Recording
from fdi_torch.simulate.experiment import lay_out
from fdi_torch.simulate.resampling import interpolate, step_means
from tests.test_gap import nominal_plant, recorded

STD = 1e-3  # m


def dense(run: Recording, times: int, seed: int = 1) -> Recording:
    """The run with so many samples in each sampling interval, and white noise of STD."""
    count = times * (len(run) - 1) + 1
    time = torch.linspace(float(run.time[0]), float(run.time[-1]), count, dtype=torch.float64)
    noise = STD * torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    outputs = torch.stack([interpolate(time, run.time, column) for column in run.outputs.T], dim=1) + noise
    return replace(run, time=time, inputs=run.inputs[torch.arange(count) // times], outputs=outputs, mask=None)


@pytest.fixture(scope="module")
def leaking() -> Recording:
    return recorded({"T1.leak.size": 0.1}, 61, samples=400)


def test_means_are_those_of_each_step_at_their_mean_time(leaking: Recording) -> None:
    run = dense(leaking, 8)
    experiment = lay_out(run, nominal_plant().channels(), 0.5)
    outputs = run.outputs.clone()
    outputs[:, 0], outputs[:, 1] = 0.1, run.time
    mask = run.mask.clone()
    mask[1:4, 2] = False
    mask[5:7, 2] = False
    sampled, means, counts = step_means(experiment, outputs, mask)
    assert len(means) == len(sampled.sample_times) == 2 * 399 + 1
    assert bool((means[:, 0] == 0.1).all()), "equal readings keep their value to the last bit"
    assert torch.allclose(means[:, 1], sampled.sample_times)
    assert float(means[2, 2]) == pytest.approx(float(outputs[7:9, 2].mean()), abs=5 * STD)
    assert counts[:, 0].tolist() == [1.0] + [4.0] * 798, "the first reading is alone in its step"
    assert counts[:4, 2].tolist() == [1.0, 1.0, 2.0, 4.0]
    nodes = sampled.nodes[sampled.sample_step] + sampled.sample_share * sampled.steps[sampled.sample_step]
    assert torch.allclose(nodes, sampled.sample_times)


def test_single_readings_are_unchanged(leaking: Recording) -> None:
    experiment = lay_out(leaking, nominal_plant().channels(), 1.0)
    sampled, means, counts = step_means(experiment, leaking.outputs, leaking.mask)
    assert (sampled, means) == (experiment, leaking.outputs)
    assert torch.equal(counts, leaking.mask.to(counts))


def test_means_of_few_readings_are_masked(leaking: Recording) -> None:
    run = dense(leaking, 8)
    mask = run.mask.clone()
    mask[1:4, 2] = False  # one of four readings of the second row is left
    mask[5:7, 2] = False  # two of the third
    rows = data_set_of(nominal_plant(), (), replace(run, mask=mask), 0.5, averaged=True).mask
    assert rows[:, 0].tolist() == [False] + [True] * 798
    assert rows[:4, 2].tolist() == [False, False, True, True]


@pytest.mark.parametrize(("share", "step"), [(0.5, 1.0), (1.9, 1.0), (2.1, 2.0), (9.0, LONGEST_STEP)])
def test_long_recordings_are_laid_out_in_longer_steps(leaking: Recording, share: float, step: float) -> None:
    """share: duration, in steps of 1 s, over MANY_STEPS. A second recording of equal length counts as well."""
    plant, rows = nominal_plant(), int(0.5 * share * MANY_STEPS)
    assert time_scale(plant) == pytest.approx(1.0)
    reading = torch.arange(rows) % len(leaking)
    inputs, outputs = leaking.inputs[reading], leaking.outputs[reading]
    time = torch.arange(rows, dtype=torch.float64)
    run = replace(leaking, time=time, inputs=inputs, outputs=outputs, mask=None)
    data = checked_data_set(plant, (), [run, run], None)
    assert data.row_spacing == pytest.approx(float(int(step)))


def test_estimates_and_standard_errors_from_means_are_those_from_all_readings(leaking: Recording) -> None:
    run, names = dense(leaking, 16), ["T1.leak.size", "P13.plugging.size"]
    clean = set_up(nominal_plant(), [run], names).engines(0.125)[0]
    truth = clean.space.vector({"T1.leak.size": 0.1, "P13.plugging.size": 0.05}).unsqueeze(0)
    noise = STD * torch.randn(run.outputs.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    mask = run.mask.clone()
    mask[100:2000:3, 1] = False
    fitting = set_up(nominal_plant(), [replace(run, outputs=clean.readings(truth)[0] + noise, mask=mask)], names)
    raw, problem = (fitting.problem(0.5, averaged=averaged) for averaged in (False, True))
    assert len(problem.terms[0].data.values) == 2 * 399 + 1 < len(raw.terms[0].data.values) / 7
    error = 4.0 / math.sqrt(2 * 799)  # four standard errors of a noise level from so many means
    start, lanes = fitting.space.nominal().unsqueeze(0), torch.zeros(1, dtype=torch.int64)
    estimates = []
    for each in (raw, problem):
        found = levenberg_marquardt(each.linearise, start, fitting.space.low(), fitting.space.high())
        assert each.noise(found.theta, lanes)[0][0].tolist() == pytest.approx([STD] * 3, rel=error)
        estimates.append((found.theta[0], information_std(each, found.theta)))
        known = each.at_noise([torch.full((3,), STD, dtype=torch.float64)])
        estimates.append((found.theta[0], information_std(known, found.theta)))
    (value, std), (_, known_std), (mean_value, mean_std), (_, mean_known_std) = estimates
    assert bool(((mean_value - value).abs() < 0.1 * std).all())
    assert torch.allclose(mean_std, std, rtol=error)
    assert torch.allclose(mean_known_std, known_std, rtol=1e-3)


def test_rows_and_steps_are_bounded_however_dense_the_samples(leaking: Recording) -> None:
    numbers = []
    for times in (2, 20, 100):
        data = problem_of(nominal_plant(), (dense(leaking, times),), (), Settings(("leak",))).data
        numbers.append((len(data.readings), len(data.experiment.nodes)))
        assert SHORTEST_STEP * (1.0 - 1e-9) <= data.row_spacing <= 1.05 * SHORTEST_STEP
    assert max(rows for rows, _ in numbers) <= 1.01 * numbers[0][0]
    assert max(nodes for _, nodes in numbers) <= 1.01 * numbers[0][1]


def test_the_quantization_is_that_of_single_readings(leaking: Recording) -> None:
    run, step = dense(leaking, 10), 2e-3
    rounded = replace(run, outputs=(run.outputs / step).round() * step)
    _, _, steps = recalibrate(problem_of(nominal_plant(), (rounded,), (), Settings(("leak",))).data)
    assert steps == pytest.approx([step] * 3)


def test_a_cause_is_named_from_means_and_outliers_are_single_readings(leaking: Recording) -> None:
    run = dense(leaking, 10)
    outputs = run.outputs.clone()
    outputs[333::700, 1] += 0.1
    answer = diagnose(nominal_plant(), replace(run, outputs=outputs), settings=Settings(("leak", "plugging")))
    assert [(c.effect, c.location) for c in answer.causes] == [("leak", "T1"), ("unknown", "h2")]
    size = answer.causes[0].parameters["size"]
    assert abs(size.value - 0.1) < 4 * size.std
    assert answer.arrays["augmented"].shape == run.outputs.shape
    assert any("6 readings of h2" in text for text in answer.remarks)


def test_predictions_at_the_recorded_times_pass_through_the_rows(leaking: Recording) -> None:
    data = problem_of(nominal_plant(), (leaking,), (), Settings(("leak",))).data
    assert torch.equal(at_recorded_times(data, data.readings), data.readings)
