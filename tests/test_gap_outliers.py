"""Outliers are distinguished from noise and from normal behaviour of tanks and sensors, and bias no fit."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from fdi_torch.gap.diagnose import Settings, diagnose
from fdi_torch.gap.preprocess.outliers import Outlier, SensorOutliers, jumps_and_returns, outliers_of
from fdi_torch.gap.problem import checked_data_set
from fdi_torch.recording import Recording
from tests.test_gap import SMALL, noise, nominal_plant, recorded

STILL = torch.zeros(3999, dtype=torch.float64)


def spans(x: Tensor, slope: Tensor = STILL) -> list[tuple[int, int]]:
    return [(a, b) for a, b, _ in jumps_and_returns(x, slope, 0.0)]


@pytest.mark.parametrize("ar", [0.0, 0.9])
def test_spikes_and_drop_outs_are_located_exactly_and_noise_has_none(ar: float) -> None:
    x = noise(4000, ar, 0.001, 7)[:, 0] + 0.05 * torch.sin(torch.arange(4000, dtype=torch.float64) / 300)
    assert spans(x) == []
    put = [(100, 101), (500, 504), (1200, 1280), (1290, 1291), (3000, 3001)]
    for k, (a, b) in enumerate(put):
        x[a:b] += 0.03 * (-1) ** k
    assert spans(x) == put


def test_the_jumps_of_an_outlier_are_counted_in_standard_deviations_of_neighbours() -> None:
    """A spike of 20 sqrt(2) standard deviations of white noise is 20 of those of the difference of two readings."""
    x = noise(4000, 0.0, 0.001, 7)[:, 0]
    x[1000] = 0.02 * math.sqrt(2.0)
    ((_, _, jumps),) = jumps_and_returns(x, STILL, 0.0)
    assert jumps == pytest.approx(20.0, rel=0.05)


def test_a_persistent_or_gradual_jump_is_no_outlier() -> None:
    time = torch.arange(4000, dtype=torch.float64)
    x = noise(4000, 0.0, 0.001, 8)[:, 0]
    assert spans(x + 0.05 * (time >= 2000)) == []
    sawtooth = 0.05 * (time % 200) / 200  # a float that sticks and slips
    assert spans(x + sawtooth) == []
    assert spans(x + 0.05 * (1.0 - (time - 2000).abs() / 40).clamp(min=0.0)) == []


def test_a_flank_that_comes_a_few_samples_late_is_no_outlier() -> None:
    time = torch.arange(4000, dtype=torch.float64)
    level = 0.02 * ((time - 1000).clamp(0, 5) - (time - 1020).clamp(0, 5))
    late = 0.02 * ((time - 1002).clamp(0, 5) - (time - 1022).clamp(0, 5))
    assert spans(late - level + noise(4000, 0.0, 0.001, 9)[:, 0], torch.diff(level).abs()) == []


def with_spikes(recording: Recording, channel: int, every: int) -> Recording:
    outputs = recording.outputs.clone()
    outputs[37::every, channel] -= 0.1
    return replace(recording, outputs=outputs)


def test_outliers_are_masked_in_their_channel_only() -> None:
    recording = with_spikes(recorded({"T1.leak.size": 0.1}, 51), 1, 90)
    (found,) = outliers_of(recording, lambda r: checked_data_set(nominal_plant(), (), r, None))
    assert found.sensor == nominal_plant().sensors[1].name and found.significant
    assert [s.rows.start for s in found.each] == list(range(37, 1000, 90))
    assert [s.times[0] for s in found.each] == [float(recording.time[s.rows.start]) for s in found.each]
    assert found.samples == len(found.each)


def test_spikes_do_not_hide_a_cause_and_are_unknown_beside_it() -> None:
    recording = with_spikes(recorded({"Q1.pump_gain.factor": 1.1}, 52, samples=500), 2, 60)
    holdout = with_spikes(recorded({"Q1.pump_gain.factor": 1.1}, 53, samples=500), 0, 60)
    answer = diagnose(nominal_plant(), recording, holdout, Settings(SMALL))
    both = [("pump_gain", "Q1"), ("unknown", nominal_plant().sensors[2].name)]
    assert answer.verdict == "unknown" and set(answer.certain) == set(both)
    assert [(c.effect, c.location) for c in answer.causes] == both
    named = diagnose(nominal_plant(), recording, settings=Settings(SMALL, named_only=True))
    assert named.verdict == "named" and [(c.effect, c.location) for c in named.causes] == both[:1]
    assert answer.closure["closed"] == pytest.approx(1.0, abs=0.03)
    assert answer.closure["augmented"] == pytest.approx(0.1, rel=0.1)  # cm: the noise, without the spikes
    sensors = [s.name for s in nominal_plant().sensors]
    assert [s for s in sensors if any(f"of {s} in" in r for r in answer.remarks)] == [sensors[0], sensors[2]]


def test_spikes_alone_are_unknown_at_their_sensor_and_a_single_one_is_no_gap() -> None:
    sound = recorded({"P13.discharge_coefficient": 0.615}, 11)
    many = diagnose(nominal_plant(), with_spikes(sound, 1, 90), settings=Settings(SMALL))
    sensor = nominal_plant().sensors[1].name
    assert many.verdict == "unknown" and many.where[0] == (sensor, 1.0) and many.p_value == 0.0
    assert [(c.effect, c.location) for c in many.causes] == many.certain == [("unknown", sensor)]
    one = diagnose(nominal_plant(), with_spikes(sound, 1, 2000), settings=Settings(SMALL))
    assert one.verdict == "no_gap"
    assert any("1 reading of" in remark for remark in one.remarks)


def test_noise_with_heavy_tails_is_nothing_wrong_with_a_sensor() -> None:
    generator = torch.Generator().manual_seed(4)
    parts = torch.randn(4, 20000, generator=generator, dtype=torch.float64)
    student = parts[0] / (parts[1:] ** 2).mean(dim=0).sqrt()  # of three degrees of freedom
    found = jumps_and_returns(student, torch.zeros(19999, dtype=torch.float64), 0.0)
    each = tuple(Outlier(slice(a, b), (float(a), float(b - 1)), height) for a, b, height in found)
    assert len(each) >= 3  # or this would test nothing
    assert not SensorOutliers("h1", "memory", each).significant
