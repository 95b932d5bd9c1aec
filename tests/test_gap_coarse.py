"""Recordings with long sampling intervals, and tanks without a sensor."""

import pytest
import torch

from fdi_torch.config.plant_file import load_plant
from fdi_torch.gap.channel_noise import estimate_noise
from fdi_torch.gap.problem import checked_data_set
from fdi_torch.plant.operating_range import operating_range_of, with_simulated_levels
from fdi_torch.recording import Recording
from tests.test_gap import nominal_plant, recorded


@pytest.mark.parametrize(("ar", "count"), [(0.0, 1024), (0.0, 6000), (0.7, 6000)])
def test_a_model_error_above_the_corner_frequency_is_not_taken_for_correlated_noise(ar: float, count: int) -> None:
    generator = torch.Generator().manual_seed(1)
    fresh = torch.randn(count, 2, dtype=torch.float64, generator=generator)
    noise, slope, level = fresh[:, 0].clone(), fresh[:, 1].clone(), torch.zeros(count, dtype=torch.float64)
    for k in range(1, count):
        noise[k] += ar * noise[k - 1]
        slope[k] += 0.9 * slope[k - 1]  # flows that are wrong for some ten samples at a time
        level[k] = 0.98 * level[k - 1] + slope[k]
    found = estimate_noise((noise + level).unsqueeze(1), torch.ones(count, 1, dtype=torch.bool))
    assert float(found.ar[0]) == pytest.approx(ar, abs=0.25)
    assert float(found.std[0]) == pytest.approx(float(noise.std()), rel=0.35)


def test_the_range_of_a_tank_without_a_sensor_is_that_of_the_model() -> None:
    plant = load_plant("cascaded_tanks")
    time = torch.arange(3, dtype=torch.float64)
    readings = torch.tensor([[1.0], [2.0], [3.0]], dtype=torch.float64)
    recording = Recording(time, readings, readings, ("u_pump",), ("y_lower_level",), ("V",), ("V",))
    plain = operating_range_of(recording, plant)
    assert plain.levels["upper"] == (0.0, pytest.approx(0.14))
    levels = torch.tensor([[0.05, 0.5], [0.08, 0.6]], dtype=torch.float64)
    found = with_simulated_levels(plain, plant, levels)
    assert found.levels["upper"] == (0.05, 0.08)
    assert found.levels["lower"] == plain.levels["lower"]


def test_samples_far_apart_are_simulated_in_shorter_steps() -> None:
    recording = recorded({"P13.discharge_coefficient": 0.615}, 11)
    steps = [
        float(checked_data_set(nominal_plant(), (), [recording.every(n)], None).experiment.steps.max())
        for n in (1, 5, 10, 12)
    ]
    assert steps == pytest.approx([1.0, 2.5, 2.5, 2.4], abs=1e-12)
