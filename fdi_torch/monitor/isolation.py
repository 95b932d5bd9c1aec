"""Fault isolation: fit every hypothesis about which parameters changed, when and by how much, and rank the fits.

Each fit starts from the onset and size at which the hypothesis' signature matches the residual best
(`initial_guesses.py`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from fdi_torch.estimate.evidence import posterior
from fdi_torch.monitor.hypothesis import (
    NO_CHANGE,
    Fault,
    Hypothesis,
    HypothesisFit,
    with_posterior,
    with_unlisted_as_one,
)
from fdi_torch.monitor.hypothesis_fit import Prior, changes_of, fit, misfit, no_change_fit, point_of
from fdi_torch.monitor.initial_guesses import (
    oscillation_guess,
    recovery_hypotheses,
    signature_guesses,
)
from fdi_torch.monitor.observer_bank import ObserverBank, ObserverWindow, no_change

DEEPEST = 2  # largest number of simultaneous faults
SMALLEST_PROBABILITY = 1e-3  # explanations below it are not fitted again


def isolate(
    observer: ObserverBank,
    window: ObserverWindow,
    believed: Tensor,
    faults: Sequence[Fault],
    growth_times: tuple[float, float] | None = None,
    deepest: int = DEEPEST,
    healthy: Tensor | None = None,
    earlier: Sequence[HypothesisFit] = (),
    flows: bool = False,
    unlisted: Sequence[Fault] = (),
    reach: float = math.inf,
) -> list[HypothesisFit]:
    """Fits of all single changes, of the best ones combined with a further fault, and of no change, likeliest first.

    All faults of a hypothesis share one onset, and a window holds one change. believed (P,): parameters before the
    change. growth_times: shortest and longest time in which a growing fault passes through its range, s; None if all
    are sudden. healthy (P,): the same without faults; if given, recovery of the faults in `believed` is a hypothesis.
    earlier: previous fits of the same change, used as further initial guesses. flows: whether random flows are learnt
    from the window too; the misfits of two calls are then not those of the same noise. unlisted: faults that are not on
    the list; together they are one explanation. reach: time over which an excess of the innovations over noise is
    averaged, s.
    """
    manners = (False, True) if growth_times else (False,)
    outside = [f.size for f in unlisted]
    counts = len(faults) * len(manners), len(outside) * len(manners)
    prior = Prior(observer.space.names, counts[0], growth_times, outside, counts[1])
    plain, others = (
        [Hypothesis((f.size,), late) for late in manners for f in group if not f.shape] for group in (faults, unlisted)
    )
    oscillating = [Hypothesis(f.columns, shape=f.shape) for f in faults if f.shape]
    base = observer.white_innovations(window, believed, no_change(believed))
    healthy = believed if healthy is None else healthy
    changes, most_pairs = [*recovery_hypotheses(believed, healthy, faults), *plain], len(faults) if deepest > 1 else 0
    single_starts, pairs = signature_guesses(observer, window, believed, healthy, changes, base, most_pairs)
    earlier = [f for f in earlier if f.hypothesis.columns]
    starts = torch.cat(
        [
            single_starts,
            signature_guesses(observer, window, believed, healthy, others, base)[0],
            *(oscillation_guess(observer, window, believed, h, base) for h in oscillating),
            *(point_of(f)[None] for f in earlier),
        ]
    )
    hypotheses = [*changes, *others, *oscillating, *(f.hypothesis for f in earlier)]
    fits = _best_of_each(fit(observer, window, believed, hypotheses, starts, misfit(base), prior))
    # Where nothing fits, the law of the plant or of a known fault is wrong: no evidence for a cause outside the list.
    fits = [f for f in fits if f.fits or f.hypothesis.columns[0] not in outside]
    for depth in range(2, deepest + 1):
        best = [f for f in fits if f.hypothesis.count < deepest and f.hypothesis.columns[0] not in outside][:2]
        origin = {b.hypothesis.with_fault(f): b for b in best for f in faults if f.size not in b.hypothesis.columns}
        wider = [h for h in origin if h not in {f.hypothesis for f in fits}]
        points = [point_of(origin[h]) for h in wider]
        # Two faults may mask each other, so that neither is among the best alone.
        for pair, start in pairs if depth == 2 else ():
            wider.append(pair)
            points.append(start)
        if not wider:
            break
        # The best fits continue as well: otherwise the gain of further iterations would count as evidence for the
        # additional fault.
        wider += [b.hypothesis for b in best]
        points += [point_of(b) for b in best]
        wider_fits = fit(observer, window, believed, wider, torch.stack(points), misfit(base), prior)
        fits = _best_of_each([*fits, *wider_fits])
    fits = [*fits, no_change_fit(observer, window, believed, base)]
    ranked = with_posterior(fits, misfits_over_excess(observer, window, believed, fits, reach))
    if flows and ranked[0].hypothesis.columns and ranked[0].fits:
        observer, ranked = with_flows_of_window(observer, window, believed, ranked, prior)
    ranked = with_unlisted_as_one(ranked, outside) if outside else ranked
    return [_beyond_range(observer, window, believed, f, prior) if f.at_bound else f for f in ranked]


def misfits_over_excess(
    observer: ObserverBank, window: ObserverWindow, believed: Tensor, fits: Sequence[HypothesisFit], reach: float
) -> list[float]:
    """The misfits, with each square divided by the mean square of the closest fit's innovations in the `reach` s about
    it, where that is above 1.

    An inexact law leaves much in some readings and nothing in others, as near the floor of a tank. If the excess were
    averaged over a longer time, exact readings would raise the weight of the inexact ones.
    """
    closest = min(range(len(fits)), key=lambda i: fits[i].misfit)
    if fits[closest].fits:
        return [f.misfit for f in fits]
    square = observer.white_innovations(window, believed, changes_of(fits)).square().sum(2)
    count = torch.isfinite(window.samples.readings[1:]).sum(1).to(square.dtype)
    total = torch.nn.functional.pad(torch.stack([square[closest], count]).cumsum(1), (1, 0))
    times = window.times.contiguous()
    first, last = (torch.searchsorted(times, times + s * reach, right=s > 0.0) for s in (-0.5, 0.5))
    near, readings = total[:, last] - total[:, first]
    return (0.5 * square / (near / readings.clamp(min=1.0)).clamp(min=1.0)).sum(1).tolist()


def with_flows_of_window(
    observer: ObserverBank,
    window: ObserverWindow,
    believed: Tensor,
    ranked: Sequence[HypothesisFit],
    prior: Prior,
) -> tuple[ObserverBank, list[HypothesisFit]]:
    """The fits repeated with random flows that are learnt from the window too, because a short fault-free part leaves
    them uncertain.

    First, the hypotheses are fitted again with the flows that are most likely under the likeliest change, apart from
    those that are far from plausible with their previous values, both with the earlier flows and with these. Then each
    plausible hypothesis, and no change, has the likelihood of the flows that are most likely under it.
    """
    likeliest = next(f for f in ranked if f.hypothesis.columns)
    observer = observer.learning_from(window, believed, changes_of([likeliest]))[0]
    base = observer.white_innovations(window, believed, no_change(believed))
    misfits = 0.5 * observer.white_innovations(window, believed, changes_of(ranked)).square().sum((1, 2))
    evidence = [f.evidence + f.misfit - now for f, now in zip(ranked, misfits.tolist(), strict=True)]
    changes = [
        f
        for f, p in zip(ranked, posterior(evidence), strict=True)
        if f.hypothesis.columns and max(f.probability, p) > SMALLEST_PROBABILITY**2
    ]
    starts, hypotheses = torch.stack([point_of(f) for f in changes]), [f.hypothesis for f in changes]
    fits = fit(observer, window, believed, hypotheses, starts, misfit(base), prior)
    fits.append(no_change_fit(observer, window, believed, base))
    plausible = (f for f in (*ranked, *with_posterior(fits)) if f.probability > SMALLEST_PROBABILITY)
    # Chance may be implausible beside the flows of a change, although its own flows explain the window.
    likely = {NO_CHANGE, *(f.hypothesis for f in plausible)}
    # The likelihoods replace the misfits, also those before the flows are learnt anew: they begin at unknown levels, so
    # that a hypothesis that explains little gains more from its flows than it has lost by its misfit.
    closest = min(fits, key=lambda f: f.misfit)
    _, likelihood, gain = observer.learning_from(window, believed, changes_of([closest]))
    start = likelihood - gain + closest.misfit
    for i, f in enumerate(fits):
        if f.hypothesis in likely:
            own = observer.learning_from(window, believed, changes_of([f]))[1]
            fits[i] = replace(f, evidence=f.evidence + f.misfit + own - start)
    return observer, with_posterior(fits, [f.misfit for f in fits])  # no misfit is left that an excess could divide


def _beyond_range(
    observer: ObserverBank, window: ObserverWindow, believed: Tensor, ended: HypothesisFit, prior: Prior
) -> HypothesisFit:
    """A fit that stopped at an end of a range, with the values and the onset that it has without that end.

    Its probability remains that of the range. At the end of the range, an earlier onset would take the place of a
    larger size.
    """
    if ended.probability < SMALLEST_PROBABILITY:
        return ended
    space = observer.search_space(ended.value)
    [free] = fit(observer, window, believed, [ended.hypothesis], point_of(ended)[None], 0.0, prior, space=space)
    wider = free.misfit_ratio**0.5
    onset = {"onset": free.onset, "onset_std": free.onset_std * wider}
    return replace(ended, value=free.value, std=free.std * wider, misfit=free.misfit, **onset)


def _best_of_each(fits: Sequence[HypothesisFit]) -> list[HypothesisFit]:
    """The best fit of each hypothesis, best first."""
    best: dict[Hypothesis, HypothesisFit] = {}
    for f in sorted(fits, key=lambda fit: -fit.evidence):
        best.setdefault(f.hypothesis, f)
    return list(best.values())
