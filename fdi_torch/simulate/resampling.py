"""Resampling: linear interpolation, and readings averaged over the steps of their simulation.

The level is a straight line within one integration step. All readings in a step therefore say no more about the plant
than their mean at their mean time, whose variance is that of one reading over their number (Ljung, 1999, "System
identification", chapter 13).
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fdi_torch.simulate.experiment import Experiment


def interpolate(
    at: Float[Tensor, " K"], times: Float[Tensor, " S"], values: Float[Tensor, " S"]
) -> Float[Tensor, " K"]:
    """Linear interpolation of values (S,) at increasing times (S,) to times `at` (K,); constant beyond the ends."""
    after = torch.searchsorted(times, at).clamp(max=len(times) - 1)
    before = (after - 1).clamp(min=0)
    width = (times[after] - times[before]).clamp(min=1e-300)
    share = ((at - times[before]) / width).clamp(0.0, 1.0)
    return torch.lerp(values[before], values[after], share)


def step_means(
    experiment: Experiment, readings: Float[Tensor, "S C"], mask: Bool[Tensor, "S C"]
) -> tuple[Experiment, Tensor, Tensor]:
    """The experiment with one sample per step, the mean readings, and the number of readings of each, (S', C) both.

    readings, mask (S, C): at the samples of the experiment, which are unchanged if no step has more than one.
    """
    ends = experiment.sample_step + (experiment.sample_share > 0.0)
    used, row = torch.unique_consecutive(ends, return_inverse=True)
    if len(used) == len(ends):
        return experiment, readings, mask.to(readings.dtype)
    times = _means(row, experiment.sample_times.unsqueeze(1))[:, 0]
    counts = readings.new_zeros(len(used), mask.shape[1]).index_add_(0, row, mask.to(readings.dtype))
    means = torch.zeros_like(counts)
    for c in range(mask.shape[1]):
        kept, of_row = mask[:, c], row[mask[:, c]]
        if not len(of_row):
            continue
        _, position = torch.unique_consecutive(of_row, return_inverse=True)
        at, values = (_means(position, x[kept, None])[:, 0] for x in (experiment.sample_times, readings[:, c]))
        means[:, c] = interpolate(times, at, values)  # a channel with missing readings has other mean times
    index = (used - 1).clamp(min=0)
    share = (times - experiment.nodes[index]) / experiment.steps[index]
    return replace(experiment, sample_times=times, sample_step=index, sample_share=share), means, counts


def _means(row: Tensor, values: Tensor) -> Tensor:
    """Means of values (S, N) by row (S,), exact for equal values."""
    shape = int(row[-1]) + 1, values.shape[1]
    highest = values.new_full(shape, -torch.inf).scatter_reduce_(0, row[:, None].expand_as(values), values, "amax")
    below = torch.zeros_like(highest).index_add_(0, row, values - highest[row])
    return highest + below / torch.bincount(row)[:, None]
