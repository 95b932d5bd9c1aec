"""All that the diagnosis of one recording came to, before it is put into numbers and words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from fdi_torch.gap.answer import CauseName, Explanation, Verdict
from fdi_torch.gap.fitting import Fit, Fitter, left_open
from fdi_torch.gap.strays import Strays
from fdi_torch.gap.where.suspects import Suspect
from fdi_torch.gap.which import Search
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.reach import Reach

ALARM = 1e-3  # chance that it is noise, above which nothing is told as unknown
UNEXPLAINED = 0.1  # share of the gap left open at which nothing has been explained


@dataclass(frozen=True)
class Weighed:
    """Explanations with their probabilities, likeliest first; fits: the best one of each."""

    explanations: tuple[Explanation, ...]
    fits: tuple[Fit, ...]


@dataclass(frozen=True)
class Finding:
    """library: what was searched. standing: the explanations that hold 95 % together. unnamed: the free discrepancy
    that closes what no effect does, if there is one. rounded: what the values themselves tell; lattice (C,): the step
    of each rounded sensor, or 0; told: the limits of sensors, with their values; strays: what was masked in the
    recordings, and in the hold-outs.
    """

    fitter: Fitter
    library: tuple[Placement, ...]
    reach: Reach
    search: Search
    places: Sequence[Suspect]
    weighed: Weighed
    standing: Sequence[Explanation]
    unnamed: Fit | None
    verdict: Verdict
    rounded: Sequence[CauseName]
    lattice: Sequence[float]
    told: Sequence[Placement] = ()
    strays: tuple[Sequence[Strays], Sequence[Strays]] = ((), ())

    @property
    def null(self) -> Fit:
        """The recalibrated plant."""
        return self.search.null

    @property
    def named(self) -> Fit:
        """The likeliest explanation that has a name."""
        return self.weighed.fits[0]

    @property
    def best(self) -> Fit:
        """What explains the recording best: with a name, or without one where that closes far more."""
        return self.unnamed or self.named

    @property
    def gap(self) -> float:
        return whole_gap(self.fitter, self.search)

    @property
    def explained(self) -> bool:
        """Whether the best explanation leaves little of the gap, or little beside the noise."""
        return left_open(self.fitter, self.best) < UNEXPLAINED * max(self.gap, float(self.fitter.subject.mask.sum()))


def whole_gap(fitter: Fitter, found: Search) -> float:
    """What the recalibrated plant leaves open: what the best explanation closes, and what that leaves."""
    return found.null.cost - found.best.cost + left_open(fitter, found.best)


def chance(found: Search) -> float:
    """That noise alone lets some option of the library gain as much as the best one does (Bonferroni)."""
    screen, singles = found.screens[found.null.key], [f.cost for f in found.fits if len(f.key) == 1]
    gain = max(float(screen.gain.max()), found.null.cost - min(singles, default=found.null.cost))
    return min(1.0, len(screen.options) * math.erfc(math.sqrt(max(gain, 0.0) / 2.0)))


def in_order(fit: Fit) -> tuple[CauseName, ...]:
    """The causes of a fit as it places them."""
    return tuple((p.effect.name, p.location) for p in fit.candidate.placements)
