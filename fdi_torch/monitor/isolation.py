"""Which fault, since when, how large: signatures against the residual first, then a fit of every hypothesis."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.estimate.evidence import log_prior, log_volume
from fdi_torch.estimate.information import certainty
from fdi_torch.estimate.levenberg_marquardt import Linearisation, RefineSettings, levenberg_marquardt
from fdi_torch.monitor.change import ChangedObserver, Changes, Window, unchanged
from fdi_torch.monitor.hypothesis import NOTHING, Fault, Finding, Hypothesis, ranked
from fdi_torch.monitor.starting import return_starts, returns, signatures, swing_start
from fdi_torch.monitor.swinging import period_step, swings_of, told_at, with_phase_errors, within_a_turn

SIZE_STEP = 1e-4  # of a parameter's range: for slopes
ITERATIONS = 12
DEEPEST = 2  # faults that may come at once


def isolate(
    observer: ChangedObserver,
    window: Window,
    believed: Tensor,
    faults: Sequence[Fault],
    incipient: bool = True,
    deepest: int = DEEPEST,
    healthy: Tensor | None = None,
    known: Sequence[Finding] = (),
) -> list[Finding]:
    """The posterior over all single changes of `faults`, the best ones together with another, and no change at all;
    likeliest first.

    One change a window: faults that come together share their onset. healthy (P,): without a fault; what is believed in
    beyond it may also go away together. known: what earlier looks at this change found, which are starts as well.
    """
    ways = (False, True) if incipient else (False,)
    prior = Prior(observer.space.names, len(faults) * len(ways))
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
    back = [] if healthy is None else returns(believed, healthy, faults)
    if healthy is not None and back:
        starts = torch.cat([starts, return_starts(observer, window, believed, healthy, back)])
    known = [f for f in known if f.hypothesis.columns]
    if known:
        starts = torch.cat([starts, torch.stack([_point(f) for f in known])])
    again = [f.hypothesis for f in known]
    found = _closest(fit(observer, window, believed, [*singles, *back, *again], starts, _misfit(base), prior))
    for _ in range(1, deepest):
        best = found[:2]
        wider = {b.hypothesis.beside(f): b for b in best for f in faults if f.size not in b.hypothesis.columns}
        # The best so far go on too: what more steps of the fit gain is no evidence for another fault.
        kept = [h for h in wider if h not in {f.hypothesis for f in found}]
        if not kept:
            break
        wider |= {b.hypothesis: b for b in best}
        kept += [b.hypothesis for b in best]
        starts = torch.stack([_point(wider[h]) for h in kept])
        found = _closest([*found, *fit(observer, window, believed, kept, starts, _misfit(base), prior)])
    return ranked([*found, nothing(observer, window, believed, base)])


@dataclass(frozen=True)
class Prior:
    """What is believed of a hypothesis before the window. names: of the space. choices: of single changes."""

    names: tuple[str, ...]
    choices: int

    def __call__(self, hypothesis: Hypothesis) -> float:
        """Log of its odds against no change. Faults that go away together do so for one reason."""
        new = [c for c in hypothesis.sizes if c not in hypothesis.gone]
        count = len(new) + bool(hypothesis.gone)
        places = len({self.names[c].partition(".")[0] for c in new}) + bool(hypothesis.gone)
        return log_prior(count, places, max(self.choices, 1))


def nothing(observer: ChangedObserver, window: Window, believed: Tensor, base: Tensor) -> Finding:
    """The explanation that nothing changed: an alarm by chance. base (1, S, sensors): its white innovations."""
    limit, first = _noise_limit(observer, window), float(window.samples.time[0])
    none = torch.zeros_like(believed)
    count = window.readings * observer.whitening.level
    return Finding(NOTHING, believed, none, first, 0.0, 0.0, _misfit(base), count, limit)


def _noise_limit(observer: ChangedObserver, window: Window) -> float:
    """Up to how large a sum of squares is noise, to four standard deviations: its own, and those of the variance that
    was learnt from `samples` of each channel.
    """
    count, channels = window.readings, len(observer.network.description.sensors)
    learnt = observer.whitening.samples * channels
    return count * observer.whitening.level * (1.0 + 4.0 * math.sqrt(2.0 / max(count, 1) + 2.0 / learnt))


def _closest(found: Sequence[Finding]) -> list[Finding]:
    """The best fit of each hypothesis, best first."""
    closest: dict[Hypothesis, Finding] = {}
    for finding in sorted(found, key=lambda finding: -finding.evidence):
        closest.setdefault(finding.hypothesis, finding)
    return list(closest.values())


def _point(finding: Finding) -> Tensor:
    """Where a fit starts from what an earlier one found, (P+1,)."""
    return torch.cat([finding.value, finding.value.new_tensor([finding.onset])])


def refit(
    observer: ChangedObserver,
    window: Window,
    believed: Tensor,
    findings: Sequence[Finding],
    choices: int,
) -> list[Finding]:
    """The same hypotheses on another window, beside what is believed (P,), from the values found before, and their
    posterior there. choices: of single changes, as when they were found.
    """
    base = observer.white(window, believed, unchanged(believed))
    kept = [f for f in findings if f.hypothesis.columns]
    starts, prior = torch.stack([_point(f) for f in kept]), Prior(observer.space.names, choices)
    found = fit(observer, window, believed, [f.hypothesis for f in kept], starts, _misfit(base), prior)
    return ranked([*found, nothing(observer, window, believed, base)])


def fit(
    observer: ChangedObserver,
    window: Window,
    believed: Tensor,
    hypotheses: Sequence[Hypothesis],
    starts: Tensor,
    base: float,
    prior: Prior,
) -> list[Finding]:
    """Sizes and onset of each hypothesis by Levenberg-Marquardt on the white innovations, all side by side.

    believed (P,); starts (H, P+1): values and onset (s) of each; base: the misfit without a change.
    """
    free = torch.zeros(len(hypotheses), len(believed) + 1, dtype=torch.bool)
    free[:, -1] = True
    for i, hypothesis in enumerate(hypotheses):
        free[i, hypothesis.free] = True
    late = torch.tensor([h.incipient for h in hypotheses])
    first, last = window.samples.time[0], window.samples.time[-2]
    swings, middle = swings_of(observer.space.names), 0.5 * float(first + last)

    def linearise(point: Tensor, lanes: Tensor) -> Linearisation:
        return _expansion(observer, window, believed, point, free[lanes], late[lanes], middle)

    held = torch.cat([believed, first[None]]).repeat(len(starts), 1)
    for i, hypothesis in enumerate(hypotheses):
        held[i, list(hypothesis.gone)] = starts[i, list(hypothesis.gone)]
    low = torch.where(free, torch.cat([observer.space.low(believed), first[None]]), held)
    high = torch.where(free, torch.cat([observer.space.high(believed), last[None]]), held)
    starts = told_at(torch.where(free, starts.clamp(low, high), held), swings, free, middle)
    for _, phase in swings:  # once round in either direction, so that no fit ends at a seam
        low[:, phase] = torch.where(free[:, phase], starts[:, phase] - 2.0 * math.pi, low[:, phase])
        high[:, phase] = torch.where(free[:, phase], starts[:, phase] + 2.0 * math.pi, high[:, phase])
    settings = RefineSettings(iterations=ITERATIONS, decrease_tolerance=1e-3, step_tolerance=1e-6)
    refined = levenberg_marquardt(linearise, starts, low, high, settings)
    final = linearise(refined.theta, torch.arange(len(hypotheses)))
    sure = certainty(final.curvature, held=~free)
    theta = within_a_turn(told_at(refined.theta, swings, free, -middle), swings, free)
    std = with_phase_errors(sure, theta, swings, free, middle)
    width = torch.cat([observer.space_width(), (last - first)[None]])
    span, limit = SIZE_STEP * (high - low), _noise_limit(observer, window)
    count = window.readings * observer.whitening.level
    stopped = free & ((refined.theta <= low + span) | (refined.theta >= high - span))
    for column, p in enumerate(observer.space):
        for natural in (p.nominal, *p.extremes):  # an end that physics has is no limit of the fit
            stopped[:, column] &= (refined.theta[:, column] - natural).abs() > span[:, column]
    return [
        Finding(
            hypothesis,
            theta[i, :-1],
            std[i, :-1],
            float(theta[i, -1]),
            float(std[i, -1]),
            base - float(final.cost[i]) + prior(hypothesis) + _volume(final.curvature[i], width, free[i], hypothesis),
            float(final.cost[i]),
            count,
            limit,
            tuple(c for c in hypothesis.sizes if bool(stopped[i, c])),
        )
        for i, hypothesis in enumerate(hypotheses)
    ]


def _volume(curvature: Tensor, width: Tensor, free: Tensor, hypothesis: Hypothesis) -> float:
    """Log of the volume of the posterior over that of the prior, of the columns that are free.

    Faults come each in its own time: that a further one shares the onset of the first costs what its own onset would.
    """
    chosen, further = free.nonzero().flatten(), len(set(hypothesis.sizes) - set(hypothesis.gone)) - 1
    onset = log_volume(curvature[-1:, -1:], width[-1:])
    return log_volume(curvature[chosen][:, chosen], width[chosen]) + max(further, 0) * onset


def _expansion(
    observer: ChangedObserver,
    window: Window,
    believed: Tensor,
    point: Tensor,
    free: Tensor,
    late: Tensor,
    middle: float,
) -> Linearisation:
    """Half the sum of squares of the white innovations about points (L, P+1), slopes by central differences.

    Free phases are those at `middle` s.
    """
    count, width = point.shape
    swings, length = swings_of(observer.space.names), float(window.samples.time[-1] - window.samples.time[0])
    steps = torch.cat([SIZE_STEP * observer.space_width(), 0.5 * torch.diff(window.samples.time).median()[None]])
    steps = steps.repeat(count, 1)
    for period, _ in swings:
        steps[:, period] = period_step(point[:, period], length)
    which = free.nonzero()  # (K, 2): lane, column
    step = steps[which[:, 0], which[:, 1]]
    ahead, behind = point[which[:, 0]].clone(), point[which[:, 0]].clone()
    rows = torch.arange(len(which))
    ahead[rows, which[:, 1]] += step
    behind[rows, which[:, 1]] -= step
    own = torch.cat([torch.arange(count), which[:, 0], which[:, 0]])
    lanes, slow = told_at(torch.cat([point, ahead, behind]), swings, free[own], -middle), late[own]
    changes = Changes(lanes[:, :-1], lanes[:, -1], slow)
    white = torch.cat([observer.white(window, believed, part).flatten(1) for part in observer.blocks(window, changes)])
    error = white[:count]
    slope = (white[count : count + len(which)] - white[count + len(which) :]) / (2.0 * step).unsqueeze(1)
    gradient, curvature = error.new_zeros(count, width), error.new_zeros(count, width, width)
    gradient[which[:, 0], which[:, 1]] = (slope * error[which[:, 0]]).sum(-1)
    for lane in range(count):
        own = (which[:, 0] == lane).nonzero().flatten()
        columns = which[own, 1]
        curvature[lane, columns.unsqueeze(1), columns] = slope[own] @ slope[own].mT
    return Linearisation(0.5 * error.square().sum(-1), gradient, curvature)


def _misfit(white: Tensor) -> float:
    return 0.5 * float(white.square().sum())
