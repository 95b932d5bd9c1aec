"""Which fault, since when, how large: signatures against the residual first, then a fit of every hypothesis."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from fdi_torch.estimate.information import certainty
from fdi_torch.estimate.refine import Linearisation, RefineSettings, levenberg_marquardt
from fdi_torch.monitor.change import ChangedObserver, Changes, Window, unchanged
from fdi_torch.monitor.hypothesis import Fault, Finding, Hypothesis
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
    known: Finding | None = None,
) -> list[Finding]:
    """All single changes of `faults`, then of the best ones together with another; best first.

    One change a window: faults that come together share their onset. healthy (P,): without a fault; what is believed in
    beyond it may also go away together. known: what an earlier look at this change found, which is a start as well.
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
    back = [] if healthy is None else returns(believed, healthy, faults)
    if healthy is not None and back:
        starts = torch.cat([starts, return_starts(observer, window, believed, healthy, back)])
    again = [] if known is None else [known.hypothesis]
    if known is not None:
        starts = torch.cat([starts, _point(known)[None]])
    found = _closest(fit(observer, window, believed, [*singles, *back, *again], starts, _misfit(base)))
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
        found = _closest([*found, *fit(observer, window, believed, kept, starts, _misfit(base))])
    told = [searched(f, len(faults)) for f in found if not needless(f, believed)]
    return doubted(told, _misfit(base))


def _closest(found: Sequence[Finding]) -> list[Finding]:
    """The best fit of each hypothesis, best first."""
    closest: dict[Hypothesis, Finding] = {}
    for finding in sorted(found, key=lambda finding: finding.score):
        closest.setdefault(finding.hypothesis, finding)
    return list(closest.values())


def _point(finding: Finding) -> Tensor:
    """Where a fit starts from what an earlier one found, (P+1,)."""
    return torch.cat([finding.value, finding.value.new_tensor([finding.onset])])


def needless(finding: Finding, believed: Tensor) -> bool:
    """Whether one of several faults is, to three standard errors, what was believed (P,) of it."""
    sizes = [c for c in finding.hypothesis.sizes if c in finding.hypothesis.free]
    change = (finding.value - believed).abs() <= 3.0 * finding.std
    return len(finding.hypothesis.sizes) > 1 and any(bool(change[c]) for c in sizes)


def searched(finding: Finding, faults: int) -> Finding:
    """Sets of several faults are many, and the best of many fits by chance: the extended BIC adds twice the logarithm
    of their number over that of single ones (Chen & Chen 2008). What goes away together is one choice.
    """
    several = len(set(finding.hypothesis.sizes) - set(finding.hypothesis.gone))
    if several < 2:
        return finding
    return replace(finding, score=finding.score + 2.0 * math.log(max(math.comb(faults, several) / faults, 1.0)))


def doubted(found: Sequence[Finding], base: float) -> list[Finding]:
    """Best first; where even the closest explanation leaves more than noise, the laws themselves are off, and what one
    says for or against another counts for less by the share of that rest: a quasi-likelihood (McCullagh & Nelder
    1989, ch. 9). base: the misfit without a change.
    """
    closest = min(found, key=lambda finding: finding.misfit)
    if not closest.fits:
        rest = 2.0 * closest.misfit / closest.readings
        found = [
            replace(
                f,
                std=f.std * rest**0.5,
                onset_std=f.onset_std * rest**0.5,
                score=f.score + 2.0 * (f.misfit - base) * (1.0 / rest - 1.0),
            )
            for f in found
        ]
    return sorted(found, key=lambda finding: finding.score)


def refit(observer: ChangedObserver, window: Window, believed: Tensor, findings: Sequence[Finding]) -> list[Finding]:
    """The same hypotheses on another window, beside what is believed (P,), from the values found before; best first."""
    base = _misfit(observer.white(window, believed, unchanged(believed)))
    starts = torch.stack([_point(f) for f in findings])
    return doubted(fit(observer, window, believed, [f.hypothesis for f in findings], starts, base), base)


def fit(
    observer: ChangedObserver,
    window: Window,
    believed: Tensor,
    hypotheses: Sequence[Hypothesis],
    starts: Tensor,
    base: float,
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
    readings = window.readings
    return [
        Finding(
            hypothesis,
            theta[i, :-1],
            std[i, :-1],
            float(theta[i, -1]),
            float(std[i, -1]),
            2.0 * (float(final.cost[i]) - base) + int(free[i].sum()) * math.log(readings),
            float(final.cost[i]),
            readings,
        )
        for i, hypothesis in enumerate(hypotheses)
    ]


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
