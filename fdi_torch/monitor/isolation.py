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
MOST_PERIODS, SWING_ONSETS = 48, 6  # tried for an oscillation
DEEPEST = 2  # faults that may come at once


@dataclass(frozen=True)
class Hypothesis:
    """Which columns of the space change together, and whether at once or little by little.

    shape: those of them that say how (period and phase of an oscillation), not how much.
    """

    columns: tuple[int, ...]
    incipient: bool = False
    shape: tuple[int, ...] = ()

    @property
    def sizes(self) -> tuple[int, ...]:
        """The columns that say how much."""
        return tuple(c for c in self.columns if c not in self.shape)

    def beside(self, fault: Fault) -> Hypothesis:
        """With another fault that comes at the same time."""
        return Hypothesis(
            tuple(sorted({*self.columns, *fault.columns})), self.incipient, tuple(sorted({*self.shape, *fault.shape}))
        )


@dataclass(frozen=True)
class Fault:
    """One fault of the list: the column of its size, and of its period and phase where it swings."""

    size: int
    shape: tuple[int, ...] = ()

    @property
    def columns(self) -> tuple[int, ...]:
        return (self.size, *self.shape)


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
    faults: Sequence[Fault],
    incipient: bool = True,
    deepest: int = DEEPEST,
) -> list[Finding]:
    """All single changes of `faults`, then of the best ones together with another; best first.

    One change a window: faults that come together share their onset.
    """
    ways = (False, True) if incipient else (False,)
    steady = [Hypothesis((f.size,), late) for late in ways for f in faults if not f.shape]
    swinging = [Hypothesis(f.columns, shape=f.shape) for f in faults if f.shape]
    singles = [*steady, *swinging]
    base = observer.white(window, believed, unchanged(believed))
    starts = torch.cat(
        [
            signatures(observer, window, believed, steady, base),
            *(swing_start(observer, window, believed, h, base) for h in swinging),
        ]
    )
    found = fit(observer, window, believed, singles, starts, _misfit(base))
    for _ in range(1, deepest):
        best = sorted(found, key=lambda finding: finding.score)[:2]
        wider = {b.hypothesis.beside(f): b for b in best for f in faults if f.size not in b.hypothesis.columns}
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
    if not hypotheses:
        return believed.new_zeros(0, len(believed) + 1)
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


def swing_start(
    observer: ChangedObserver, window: Window, believed: Tensor, hypothesis: Hypothesis, base: Tensor
) -> Tensor:
    """The same (1, P+1) for an oscillation: its period from a grid half a swing of the window apart, amplitude and
    phase by least squares on the signatures of a sine and a cosine.
    """
    size, period, phase = hypothesis.columns[0], *hypothesis.shape
    first, last = float(window.samples.time[0]), float(window.samples.time[-1])
    sampling, bounds = float(torch.diff(window.samples.time).median()), observer.space.parameters[period]
    fastest, slowest = max(4.0 * sampling, bounds.low), min(2.0 * (last - first), bounds.high)
    count = min(max(int(2.0 * (last - first) / fastest), 2), MOST_PERIODS)
    periods = 1.0 / torch.linspace(1.0 / slowest, 1.0 / fastest, count, dtype=believed.dtype)
    onsets = first + (last - first) * (torch.arange(SWING_ONSETS, dtype=believed.dtype) + 0.5) / SWING_ONSETS
    grid = torch.cartesian_prod(periods, onsets, believed.new_tensor([0.0, 0.5 * torch.pi]))
    theta = believed.repeat(len(grid), 1)
    trial = TRIAL_SIZE * float(observer.space_width()[size])
    theta[:, size], theta[:, period], theta[:, phase] = trial, grid[:, 0], grid[:, 2]
    changes = Changes(theta, grid[:, 1], torch.zeros(len(grid), dtype=torch.bool))
    products = []
    for part in observer.blocks(window, changes, even=2):
        shape = (base - observer.white(window, believed, part)).flatten(1).reshape(len(part) // 2, 2, -1)
        columns = torch.cat([shape, base.flatten(1).expand(len(shape), 1, -1)], dim=1)
        products.append(columns @ columns.mT)
    gram = torch.cat(products)
    normal = gram[:, :2, :2] + 1e-12 * gram[:, :2, :2].diagonal(dim1=1, dim2=2).amax(1).clamp(min=1e-30)[
        :, None, None
    ] * torch.eye(2, dtype=gram.dtype)
    scale = torch.linalg.solve(normal, gram[:, :2, 2:])[..., 0]
    best = int((scale * gram[:, :2, 2]).sum(1).argmax())
    sine, cosine = scale[best].tolist()
    start = believed.clone()
    amplitude = trial * float(scale[best].norm())
    start[size] = min(amplitude, observer.space.parameters[size].high)
    start[period], start[phase] = grid[2 * best, 0], math.atan2(cosine, sine)
    return torch.cat([start, grid[2 * best, 1][None]])[None]


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
