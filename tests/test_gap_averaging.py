"""Readings that are denser than the integration steps count by their means: work and memory do not grow with them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from fdi_torch.gap.dataset import at_recorded_times
from fdi_torch.gap.diagnose import Settings, diagnose, recalibrate
from fdi_torch.gap.problem import SHORTEST_STEP, problem_of
from fdi_torch.gap.resampling import interpolate, step_means
from fdi_torch.recording import Recording
from fdi_torch.simulate.experiment import lay_out
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
    sampled, means, valid = step_means(experiment, outputs, mask)
    assert len(means) == len(sampled.sample_times) == 2 * 399 + 1
    assert bool((means[:, 0] == 0.1).all()), "equal readings keep their value to the last bit"
    assert torch.allclose(means[:, 1], sampled.sample_times)
    assert float(means[2, 2]) == pytest.approx(float(outputs[7:9, 2].mean()), abs=5 * STD)
    assert valid[:, 0].tolist() == [False] + [True] * 798, "the first reading is alone in its step"
    assert valid[:4, 2].tolist() == [False, False, True, True]
    nodes = sampled.nodes[sampled.sample_step] + sampled.sample_share * sampled.steps[sampled.sample_step]
    assert torch.allclose(nodes, sampled.sample_times)


def test_single_readings_are_unchanged(leaking: Recording) -> None:
    experiment = lay_out(leaking, nominal_plant().channels(), 1.0)
    assert step_means(experiment, leaking.outputs, leaking.mask) == (experiment, leaking.outputs, leaking.mask)


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
    assert any("its 3991 samples are averaged over integration steps of 0.5 s" in text for text in answer.remarks)
    assert any("6 readings of h2" in text for text in answer.remarks)


def test_predictions_at_the_recorded_times_pass_through_the_rows(leaking: Recording) -> None:
    data = problem_of(nominal_plant(), (leaking,), (), Settings(("leak",))).data
    assert torch.equal(at_recorded_times(data, data.readings), data.readings)
