"""The choice among explanations by what they predict of stretches that their numbers were not fitted to.

No library has the true equations. Where the best explanation leaves a good part of a gap open, what closes a bit more
of it need not be what the rig has: it may only take up what another equation misses, and far from the readings that it
was fitted to it is wrong. So each explanation is fitted again without each of STRETCHES in turn; its trajectory runs on
through the stretch, freely, and is compared with the readings there (Stone, 1974, "Cross-validatory choice", for
blocks). With m_b the mean square of the errors in stretch b, in units of the noise, and m_0 what the best explanation
leaves of the readings it was fitted to,

    log weight = -n/2 sum_b log(m_b + m_0) + log prior

as for n independent errors a stretch of unknown variance each. What comes with how a component is built costs its odds
once, whether it is at one component or at all that are alike; where it is at one alone, that costs the odds once more.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.gap.alike import missing, repeated, with_repeated
from fdi_torch.gap.answer import CauseName, Explanation
from fdi_torch.gap.evidence import LOG_PRIOR_EFFECT, posterior
from fdi_torch.gap.finding import Weighed, in_order
from fdi_torch.gap.fitting import Candidate, Fit, Fitter, Key
from fdi_torch.gap.library import canonical
from fdi_torch.gap.which import PROMISE, Search
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.reach import Reach

STRETCHES = 6
START = 50  # first samples of every recording, or half a stretch, are never left out: they tell its start levels
INDEPENDENT = 4.0  # errors in a stretch: slow ones of a free run
FIRST, OF_EACH = 10, 4  # best fits that are weighed: of all, and of each number of effects
WITHIN = 5.0  # times as much as the best explanation leaves, beyond which none is weighed
ROUNDS, SETTLED = 15, 20.0


@dataclass(frozen=True)
class Chosen:
    """The search with what was fitted besides, and its explanations by what they predict."""

    search: Search
    weighed: Weighed


def chosen(fitter: Fitter, found: Search, plant: PlantDescription, reach: Reach) -> Chosen:
    """Weighs the best fits of a search, and with each what it lacks at components that are alike."""
    pool = _pool(found.fits)
    for fit in list(pool.values()):
        for wider in with_repeated(fitter, fit, plant, reach):
            if fit.cost - wider.cost > PROMISE and wider.cost < pool.get(wider.key, fit).cost:
                pool[wider.key] = wider
    best = min(f.cost for f in pool.values())
    fits = _by_name([f for f in pool.values() if f.cost < WITHIN * best], plant)
    left = min(float(_squares(fitter, f, fitter.subject.mask)) for f in fits)
    weights = posterior([_log_weight(fitter, f, left, plant) for f in fits])
    ranked = sorted(zip(weights, fits, strict=True), key=lambda item: -item[0])
    every = {f.key: f for f in found.fits} | pool
    search = replace(found, fits=tuple(sorted(every.values(), key=lambda f: f.cost)))
    return Chosen(search, Weighed(tuple(Explanation(in_order(f), w) for w, f in ranked), tuple(f for _, f in ranked)))


def errors_unseen(fitter: Fitter, fit: Fit) -> list[float]:
    """Mean squares of the errors in each stretch (in units of the noise), by fits without it."""
    found = []
    for stretch in _stretches(fitter):
        out = fitter.subject.mask & stretch.unsqueeze(1)
        if bool(out.any()):
            candidate = Candidate(fit.candidate.placements, (fit.effect_values,))
            rest = _without(fitter, out).fit(candidate, fit, rounds=ROUNDS, settled=SETTLED)
            found.append(float(_squares(fitter, rest, out)))
    return found


def _log_weight(fitter: Fitter, fit: Fit, left: float, plant: PlantDescription) -> float:
    log_errors = sum(math.log(error + left) for error in errors_unseen(fitter, fit))
    count = len(fit.key) - repeated(fit.key, plant) + len(missing(fit.key, plant))
    weight = -0.5 * INDEPENDENT * log_errors + count * LOG_PRIOR_EFFECT
    return weight if math.isfinite(weight) else -math.inf


def _pool(fits: Sequence[Fit]) -> dict[Key, Fit]:
    """fits: best first."""
    sizes = sorted({len(f.key) for f in fits} - {0})
    each = [f for size in sizes for f in [f for f in fits if len(f.key) == size][:OF_EACH]]
    return {f.key: f for f in (*fits[:FIRST], *each)}


def _by_name(fits: Sequence[Fit], plant: PlantDescription) -> list[Fit]:
    """Names of one thing count once."""
    best: dict[frozenset[CauseName], Fit] = {}
    for fit in fits:
        key = frozenset(canonical(c, plant) for c in fit.key)
        if key not in best or fit.cost < best[key].cost:
            best[key] = fit
    return list(best.values())


def _stretches(fitter: Fitter) -> list[Tensor]:
    """Which samples (S,) each leaves out."""
    count = len(fitter.subject.mask)
    turn, kept = torch.arange(count) * STRETCHES // count, torch.zeros(count, dtype=torch.bool)
    for rows in fitter.subject.rows:
        kept[rows.start : rows.start + min(START, count // (2 * STRETCHES))] = True
    return [(turn == k) & ~kept for k in range(STRETCHES)]


def _without(fitter: Fitter, out: Tensor) -> Fitter:
    """The same fitter that does not see some readings (S, C)."""
    subject = fitter.subject
    mask = subject.mask & ~out
    further = [replace(p, mask=mask[rows]) for p, rows in zip(subject.further, subject.rows[1:], strict=True)]
    return Fitter(replace(subject, mask=mask, further=tuple(further)), fitter.noise)


def _squares(fitter: Fitter, fit: Fit, which: Tensor) -> Tensor:
    off = (fitter.subject.readings - fit.near.readings[0]) / fitter.noise.std
    return torch.where(which, off, 0.0).square().sum() / which.sum()
