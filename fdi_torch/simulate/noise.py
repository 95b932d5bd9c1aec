"""Measurement noise of simulated recordings."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

SnrDefinition = Literal["variance", "power"]


def noise_std(readings: Tensor, snr_db: float, definition: SnrDefinition = "variance") -> Tensor:
    """Standard deviation (*batch, C) that gives each channel of readings (*batch, S, C) a signal-to-noise ratio in dB.

    'variance': against the signal's variance; 'power': against its mean square. Raises ValueError for a constant
    channel, whose variance-based ratio is undefined.
    """
    if definition not in ("variance", "power"):
        raise ValueError(f"expected an SNR definition of variance, power, got '{definition}'")
    signal = readings.var(dim=-2, correction=0) if definition == "variance" else (readings**2).mean(dim=-2)
    spread = readings.amax(dim=-2) - readings.amin(dim=-2)
    if definition == "variance" and bool((spread <= 1e-9 * readings.abs().amax(dim=-2)).any()):
        raise ValueError(
            "expected channels that vary, got a constant one, whose signal-to-noise ratio against the variance is "
            "undefined; give the noise's standard deviation, or the definition 'power'"
        )
    return torch.sqrt(signal / 10.0 ** (snr_db / 10.0))


def gaussian_noise(shape: tuple[int, ...], std: Tensor, generator: torch.Generator, ar: float = 0.0) -> Tensor:
    """Gaussian noise (*batch, S, C) of standard deviation std (*batch, C); ar: its AR(1) coefficient over samples."""
    noise = torch.randn(shape, generator=generator, dtype=std.dtype, device=generator.device)
    if ar:
        steps = list(noise.unbind(-2))
        for k in range(1, len(steps)):
            steps[k] = ar * steps[k - 1] + (1.0 - ar * ar) ** 0.5 * steps[k]
        noise = torch.stack(steps, dim=-2)
    return noise * std.unsqueeze(-2)
