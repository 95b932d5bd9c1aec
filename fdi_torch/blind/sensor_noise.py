"""Noise of the hidden rigs' readings: white noise through a filter of unit energy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from fdi_torch.blind.deviation import Array

LONGEST = 120
_AT = np.arange(LONGEST, dtype=np.float64)


@dataclass(frozen=True)
class NoiseCorrelation:
    """Moving-average noise e_i = sum_j k_j w_(i-j) with sum k_j^2 = 1. kernel: k."""

    name: str
    kernel: Array = field(default_factory=lambda: np.ones(1))

    @property
    def correlations(self) -> Array:
        """Autocorrelation (2 L - 1,) from the most negative lag to the most positive one; 1 in the middle."""
        return np.correlate(self.kernel, self.kernel, "full")

    @property
    def repeats(self) -> float:
        """Number of readings equivalent to one independent reading in mean squares: the sum of squared correlations."""
        return float(np.sum(self.correlations**2))

    def noise(self, rng: np.random.Generator, samples: int, std: Array) -> Array:
        """Noise (T, S) with these standard deviations (S,)."""
        white = rng.normal(size=(samples + len(self.kernel) - 1, len(std)))
        return std * np.stack([np.convolve(column, self.kernel, "valid") for column in white.T], axis=1)


WHITE = NoiseCorrelation("white")


def autoregressive(coefficient: float) -> NoiseCorrelation:
    """First-order autoregression e_i = a e_(i-1) + w_i."""
    return _of_unit_energy("autoregressive", np.power(coefficient, _AT))


def smoothed(samples: int) -> NoiseCorrelation:
    """Moving average of a transmitter over its last few samples."""
    return _of_unit_energy("smoothed", np.ones(samples))


def rippling(period: float, lasting: float) -> NoiseCorrelation:
    """Damped oscillation with a period and a decay time in samples (AR(2))."""
    return _of_unit_energy("rippling", np.exp(-_AT / lasting) * np.cos(2 * np.pi * _AT / period))


# Share of the rigs with each correlation, and its drawing; the shares add up to 1.
DRAWN: tuple[tuple[float, Callable[[np.random.Generator], NoiseCorrelation]], ...] = (
    (0.7, lambda rng: autoregressive(float(rng.uniform(0.6, 0.9)))),
    (0.15, lambda rng: smoothed(int(rng.integers(3, 9)))),
    (0.15, lambda rng: rippling(float(rng.uniform(6, 14)), float(rng.uniform(3, 6)))),
)


def draw_correlation(rng: np.random.Generator) -> NoiseCorrelation:
    """A random correlation, mostly AR(1)."""
    shares, draws = zip(*DRAWN, strict=True)
    return draws[rng.choice(len(draws), p=shares)](rng)


def _of_unit_energy(name: str, kernel: Array) -> NoiseCorrelation:
    return NoiseCorrelation(name, kernel / np.sqrt(np.sum(kernel**2)))
