"""The trajectory that the readings tell, about which a discrepancy of any size adds up linearly.

A flow that the model lacks is what a known trajectory leaves over; about the trajectory of a model that misses it,
every effect of it on heads and roots would have to be guessed as well.
"""

from __future__ import annotations

import torch
from torch import Tensor

from fdi_torch.gap.fitting import Fit
from fdi_torch.gap.subject import Subject

WIDTH = 4.0  # samples, of the bell with which readings are smoothed
REACH = 8


def followed(subject: Subject, fit: Fit) -> Tensor:
    """Levels (1, K+1, tanks) of all recordings: as read, smoothed; as the fit has them where no sensor sees a tank."""
    levels, tanks = fit.near.levels.clone(), [t.name for t in subject.plant.tanks]
    first = 0
    for part in subject.parts:
        nodes, times = part.experiment.nodes, part.experiment.sample_times
        for c, sensor in enumerate(subject.plant.sensors):
            told = part.mask[:, c]
            if int(told.sum()) < 2:
                continue
            read = smoothed(part.readings[:, c], told)[told]
            level = (between(nodes, times[told], read) - sensor.offset) / sensor.gain
            levels[0, first : first + len(nodes), tanks.index(sensor.tank)] = level.clamp(min=0.0)
        first += len(nodes)
    return levels


def smoothed(x: Tensor, mask: Tensor) -> Tensor:
    """x (S,): at each sample the value of the straight line through its surroundings; masked ones have no weight."""
    offset = torch.arange(-REACH, REACH + 1, dtype=x.dtype)
    bell = torch.exp(-0.5 * (offset / WIDTH) ** 2)

    def moment(y: Tensor, power: int) -> Tensor:
        kernel = (bell * offset**power).reshape(1, 1, -1)
        return torch.nn.functional.conv1d(y.reshape(1, 1, -1), kernel, padding=REACH)[0, 0]

    weight, value = mask.to(x.dtype), torch.where(mask, x, 0.0)
    one, skew, spread = (moment(weight, p) for p in (0, 1, 2))
    mean, slope = moment(value, 0), moment(value, 1)
    det = one * spread - skew * skew
    line = (spread * mean - skew * slope) / det.clamp(min=1e-12)
    return torch.where(det > 1e-6 * one * one, line, mean / one.clamp(min=1e-12))


def between(at: Tensor, times: Tensor, values: Tensor) -> Tensor:
    """values (S,) at increasing times (S,), straight between them and constant beyond them, at `at` (K,)."""
    right = torch.searchsorted(times, at).clamp(1, len(times) - 1)
    span = times[right] - times[right - 1]
    share = ((at - times[right - 1]) / span).clamp(0.0, 1.0)
    return values[right - 1] + share * (values[right] - values[right - 1])
