"""Onset times and intervals from which fits start.

Under sensor noise alone the cost has a wide minimum about an onset, and a coarse grid of starts suffices. Random flows
with a long correlation time make it narrow: they explain a flow that changed some time ago. A random flow of standard
deviation q into a tank of area A moves the level by q t / A within a time t, and the mean of the readings until then
has the standard error s sqrt(dt / t). Both are equal after

    t = (s A sqrt(dt) / q)^(2/3)

The readings show a random flow after this time t, so the minimum about an onset is a few t wide.

An effect between two instants is to first order the difference of two effects that begin at these instants and do not
end. The gain of every interval on a grid therefore follows from the products of the grid's steps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from fdi_torch.gap.candidate import Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.screening import Option, ScreeningResult, products, screen

SPACING = 4.0  # times t; no onset is further than 2 t from a start, where most of its gain is left
MAX_ONSETS = 127  # of an effect, a limit on computing time
MIN_INSTANTS = 60  # of the grid on which intervals begin and end
INTERVALS = 4  # the likeliest intervals of an effect, from each of which a fit starts


def with_fine_onsets(fitter: Fitter, fit: Fit, screening: ScreeningResult, effects: int) -> ScreeningResult:
    """A screening with further onset times and intervals of its most promising `effects`."""
    promising = screening.promising(effects)
    further = fine_onsets(promising, fitter) + likeliest_intervals(promising, fitter, fit)
    return screening + screen(fitter, fit, further) if further else screening


def fine_onsets(options: Sequence[Option], fitter: Fitter) -> list[Option]:
    """Further onset times of the effects that start from a grid of them, as dense as the random flows in the fitter's
    noise require."""
    duration, count = fitter.data.longest_duration, _count(fitter)
    further: list[Option] = []
    grids: dict[tuple[tuple[str, str], tuple[tuple[str, float], ...]], list[Option]] = {}
    for option in options:
        if option.late:
            others = tuple((n, v) for n, v in option.start.items() if n not in option.instants)
            grids.setdefault((option.cause, others), []).append(option)
    for first, *rest in grids.values():
        if rest and 1 + len(rest) < count:  # a start that differs from all others in further parameters is no grid
            times = [duration * (k + 1) / (count + 1) for k in range(count)]
            further += [replace(first, start={**first.start, first.instants[0]: time}) for time in times]
    return further


def likeliest_intervals(options: Sequence[Option], fitter: Fitter, fit: Fit) -> list[Option]:
    """The intervals in which these options explain most in addition to a fit, for effects that begin and end."""
    count, duration = max(_count(fitter), MIN_INSTANTS), fitter.data.longest_duration
    times = torch.arange(count, dtype=torch.float64) * duration / count
    further: list[Option] = []
    for option in {o.cause: o for o in options}.values():
        if len(option.instants) == 2:
            begin, lasting = option.instants
            steps = [replace(option, start={**option.start, begin: t, lasting: duration}) for t in times.tolist()]
            size = next(iter(option.start))
            for first, beyond, sign in _best_pairs(*products(fitter, fit, steps)):
                # An end exactly at the last sample would be a kink of the cost.
                lasts = float(times[beyond] - times[first]) if beyond < count else duration
                start = {begin: float(times[first]), lasting: lasts}
                further.append(replace(option, start={**option.start, **start, size: sign * option.start[size]}))
    return further


def _best_pairs(score: Tensor, gram: Tensor) -> list[tuple[int, int, float]]:
    """First step, step at which it ends (M: never), and sign of the size, of the pairs with the largest local maxima of
    the gain. score (M,) and gram (M, M) of steps that do not end.
    """
    score, gram = torch.nn.functional.pad(score, (0, 1)), torch.nn.functional.pad(gram, (0, 1, 0, 1))
    strength = torch.diagonal(gram).unsqueeze(0) + torch.diagonal(gram).unsqueeze(1) - 2.0 * gram
    difference = score.unsqueeze(1) - score.unsqueeze(0)
    visible = torch.triu(torch.ones_like(gram), diagonal=1).bool() & (strength > 1e-6)
    gain = torch.where(visible, difference.square() / strength.clamp(min=1e-6), 0.0)
    highest = torch.nn.functional.max_pool2d(gain[None, None], 3, 1, 1)[0, 0]
    order = torch.where(gain == highest, gain, 0.0).flatten().argsort(descending=True)[:INTERVALS].tolist()
    pairs = [divmod(flat, len(gain)) for flat in order]
    return [(i, j, math.copysign(1.0, float(difference[i, j]))) for i, j in pairs if float(gain[i, j]) > 0.0]


def _count(fitter: Fitter) -> int:
    """Number of instants that random flows require."""
    return min(math.ceil(fitter.data.longest_duration / (SPACING * detection_time(fitter))), MAX_ONSETS)


def detection_time(fitter: Fitter) -> float:
    """The shortest time t (s) after which the readings show a random flow; infinite if these are forgotten sooner."""
    whitening = fitter.whitening
    if whitening is None:
        return math.inf
    propagation, noise = whitening.own.propagation, whitening.noise
    areas = torch.tensor([t.area for t in fitter.data.plant.tanks], dtype=torch.float64)
    sensitivity = propagation.output.abs().amax(dim=0)[:, : len(areas)]
    std = fitter.noise.std * noise.scale
    level_noise = (std.unsqueeze(1) / sensitivity).amin(dim=0)
    shortest = float(((level_noise * areas * math.sqrt(propagation.usual_interval) / noise.intensity) ** (2 / 3)).min())
    shortest = max(shortest, propagation.usual_interval)
    return shortest if noise.correlation_time > shortest else math.inf
