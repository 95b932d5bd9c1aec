"""Noise of readings from their second differences."""

from __future__ import annotations

import pytest
import torch

from fdi_torch.sample_noise import sample_noise


def test_noise_is_estimated_beside_a_moving_signal_and_masked_readings() -> None:
    time = torch.arange(5000.0, dtype=torch.float64)
    noise = torch.randn(5000, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    values = torch.sin(time / 50.0)[:, None] + noise * torch.tensor([1e-3, 5e-3])
    assert sample_noise(values).tolist() == pytest.approx([1e-3, 5e-3], rel=0.05)
    values[::4] += 1.0
    weight = torch.ones_like(values)
    weight[::4] = 0.0
    assert sample_noise(values).min() > 0.1  # without the mask
    assert sample_noise(values, weight).tolist() == pytest.approx([1e-3, 5e-3], rel=0.1)


def test_too_few_readings_show_no_noise() -> None:
    assert sample_noise(torch.ones(2, 3)).tolist() == [0.0, 0.0, 0.0]
