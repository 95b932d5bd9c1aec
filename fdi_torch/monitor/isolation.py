"""Which fault, since when, how large: signatures against the residual first, then a fit of every hypothesis."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.estimate.information import certainty
from fdi_torch.estimate.refine import Linearisation, RefineSettings, levenberg_marquardt
from fdi_torch.monitor.change import ChangedObserver, Changes, Window, unchanged

ONSETS = 24  # moments tried in a window before the fit makes them continuous
SIZE_STEP = 1e-4  # of a parameter's range: for slopes
TRIAL_SIZE = 0.02  # of a parameter's range: for signatures
ITERATIONS = 12
DEEPEST = 2  # faults that may come at once


@dataclass(frozen=True)
class Hypothesis:
    """Which columns of the space change together, and whether at once or little by little."""

    columns: tuple[int, ...]
    incipient: bool = False


@dataclass(frozen=True)
class Finding:
    """A hypothesis fitted: value and std (P,) of its columns (others as believed, 0), onset and its std in s.

    score: Bayesian information criterion against "no change"; the most negative is the best.
    misfit: half the sum of squares of the white innovations. readings: how many there were.
    """

    hypothesis: Hypothesis
    value: Tensor
    std: Tensor
    onset: float
    onset_std: float
    score: float
    misfit: float
    readings: int

    @property
    def fits(self) -> bool:
        """Whether the white innovations are no larger than noise, to four standard deviations of their squares' sum."""
        return 2.0 * self.misfit <= self.readings + 4.0 * (2.0 * self.readings) ** 0.5


def isolate(
    observer: ChangedObserver,
    window: Window,
    believed: Tensor,
    columns: Sequence[int],
    incipient: bool = True,
    deepest: int = DEEPEST,
) -> list[Finding]:
    """All single changes of `columns`, then of the best ones together with another; best first.

    One change a window: faults that come together share their onset.
    """
    shapes = (False, True) if incipient else (False,)
    singles = [Hypothesis((c,), late) for late in shapes for c in columns]
    base = observer.white(window, believed, unchanged(believed))
    starts = signatures(observer, window, believed, singles, base)
    found = fit(observer, window, believed, singles, starts, _misfit(base))
    for _ in range(1, deepest):
        best = sorted(found, key=lambda finding: finding.score)[:2]
        wider = {
            Hypothesis(tuple(sorted({*b.hypothesis.columns, c})), b.hypothesis.incipient): b
            for b in best
            for c in columns
            if c not in b.hypothesis.columns
        }
        kept = [h for h in wider if h not in {f.hypothesis for f in found}]
        if not kept:
            break
        again = torch.stack([torch.cat([wider[h].value, wider[h].value.new_tensor([wider[h].onset])]) for h in kept])
        found += fit(observer, window, believed, kept, again, _misfit(base))
    return sorted(found, key=lambda finding: finding.score)


def refit(observer: ChangedObserver, window: Window, believed: Tensor, findings: Sequence[Finding]) -> list[Finding]:
    """The same hypotheses on another window, from the values found before."""
    base = _misfit(observer.white(window, believed, unchanged(believed)))
    starts = torch.stack([torch.cat([f.value, f.value.new_tensor([f.onset])]) for f in findings])
    return fit(observer, window, believed, [f.hypothesis for f in findings], starts, base)


def signatures(
    observer: ChangedObserver, window: Window, believed: Tensor, hypotheses: Sequence[Hypothesis], base: Tensor
) -> Tensor:
    """The size and the onset (H, P+1) at which each hypothesis' signature matches the residual best.

    Generalised likelihood ratio over faults and onsets (Willsky & Jones 1976): the residual's shape of a small fault,
    scaled to fit. base (1, S, sensors): the white innovations without a change.
    """
    first, last = float(window.samples.time[0]), float(window.samples.time[-1])
    onsets = first + (last - first) * (torch.arange(ONSETS, dtype=believed.dtype) + 0.5) / ONSETS
    theta = believed.repeat(len(hypotheses), ONSETS, 1)
    move = TRIAL_SIZE * observer.space_width()
    for i, hypothesis in enumerate(hypotheses):
        for c in hypothesis.columns:
            theta[i, :, c] += _inward(observer, believed, c, float(move[c]))
    late = torch.tensor([h.incipient for h in hypotheses]).repeat_interleave(ONSETS)
    changes = Changes(theta.flatten(0, 1), onsets.repeat(len(hypotheses)), late)
    matches, powers = [], []
    for part in observer.blocks(window, changes):
        shape = base - observer.white(window, believed, part)
        matches.append((shape * base).sum((1, 2)))
        powers.append(shape.square().sum((1, 2)).clamp(min=1e-30))
    match, power = (torch.cat(rows).reshape(len(hypotheses), ONSETS) for rows in (matches, powers))
    best = (match**2 / power).argmax(dim=1)
    rows = torch.arange(len(hypotheses))
    scale = (match / power)[rows, best].unsqueeze(-1)
    value = believed + (theta[rows, best] - believed) * scale
    low, high = observer.space.low(believed), observer.space.high(believed)
    return torch.cat([value.clamp(low, high), onsets[best].unsqueeze(-1)], dim=-1)


def fit(
    observer: ChangedObserver,
    window: Window,
    believed: Tensor,
    hypotheses: Sequence[Hypothesis],
    starts: Tensor,
    base: float,
) -> list[Finding]:
    """Sizes and onset of each hypothesis by Levenberg-Marquardt on the white innovations, all side by side."""
    free = torch.zeros(len(hypotheses), len(believed) + 1, dtype=torch.bool)
    free[:, -1] = True
    for i, hypothesis in enumerate(hypotheses):
        free[i, list(hypothesis.columns)] = True
    late = torch.tensor([h.incipient for h in hypotheses])

    def linearise(point: Tensor, lanes: Tensor) -> Linearisation:
        return _expansion(observer, window, believed, point, free[lanes], late[lanes])

    first, last = window.samples.time[0], window.samples.time[-2]
    held = torch.cat([believed, first[None]]).expand_as(starts)
    low = torch.where(free, torch.cat([observer.space.low(believed), first[None]]), held)
    high = torch.where(free, torch.cat([observer.space.high(believed), last[None]]), held)
    start = torch.where(free, starts, held)
    start[:, -1] = starts[:, -1]
    settings = RefineSettings(iterations=ITERATIONS, decrease_tolerance=1e-3, step_tolerance=1e-6)
    refined = levenberg_marquardt(linearise, start, low, high, settings)
    final = linearise(refined.theta, torch.arange(len(hypotheses)))
    sure = certainty(final.curvature, held=~free)
    readings = window.readings
    return [
        Finding(
            hypothesis,
            refined.theta[i, :-1],
            sure.std[i, :-1],
            float(refined.theta[i, -1]),
            float(sure.std[i, -1]),
            2.0 * (float(final.cost[i]) - base) + int(free[i].sum()) * math.log(readings),
            float(final.cost[i]),
            readings,
        )
        for i, hypothesis in enumerate(hypotheses)
    ]


def _expansion(
    observer: ChangedObserver, window: Window, believed: Tensor, point: Tensor, free: Tensor, late: Tensor
) -> Linearisation:
    """Half the sum of squares of the white innovations about points (L, P+1), slopes by central differences."""
    count, width = point.shape
    steps = torch.cat([SIZE_STEP * observer.space_width(), 0.5 * torch.diff(window.samples.time).median()[None]])
    which = free.nonzero()  # (K, 2): lane, column
    ahead, behind = point[which[:, 0]].clone(), point[which[:, 0]].clone()
    rows = torch.arange(len(which))
    ahead[rows, which[:, 1]] += steps[which[:, 1]]
    behind[rows, which[:, 1]] -= steps[which[:, 1]]
    lanes = torch.cat([point, ahead, behind])
    slow = torch.cat([late, late[which[:, 0]], late[which[:, 0]]])
    changes = Changes(lanes[:, :-1], lanes[:, -1], slow)
    white = torch.cat([observer.white(window, believed, part).flatten(1) for part in observer.blocks(window, changes)])
    error = white[:count]
    slope = (white[count : count + len(which)] - white[count + len(which) :]) / (2.0 * steps[which[:, 1]]).unsqueeze(1)
    gradient, curvature = error.new_zeros(count, width), error.new_zeros(count, width, width)
    gradient[which[:, 0], which[:, 1]] = (slope * error[which[:, 0]]).sum(-1)
    for lane in range(count):
        own = (which[:, 0] == lane).nonzero().flatten()
        columns = which[own, 1]
        curvature[lane, columns.unsqueeze(1), columns] = slope[own] @ slope[own].mT
    return Linearisation(0.5 * error.square().sum(-1), gradient, curvature)


def _misfit(white: Tensor) -> float:
    return 0.5 * float(white.square().sum())


def _inward(observer: ChangedObserver, believed: Tensor, column: int, size: float) -> float:
    """A small change that stays within the parameter's range."""
    return size if float(believed[column]) + size <= observer.space.parameters[column].high else -size
