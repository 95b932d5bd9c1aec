"""Causes tied to the clock of one recording, and what they have to close to be followed.

An onset, a phase, a drift since the start are free in every recording and not to be expected in the next one, so that
no other stretch ever tests them, and they take up what any equation misses: a step where its error changes sign, a wave
where it swings. Where a good part of the gap is open, an effect that stands as it is comes first: one tied to the clock
has to close more than is left open beside it. Where it is the cause it leaves next to nothing, and pays.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

from fdi_torch.gap.fitting import Fit, Fitter, Key, left_open

LEAST = 150.0  # chi-square units left open, below which it may be noise that is left


def tied(fit: Fit) -> list[tuple[str, str]]:
    """The causes of a fit of which a parameter that means a moment or a pace was fitted."""
    return [
        (p.effect.name, p.location)
        for p in fit.candidate.placements
        if any(f"{p.prefix}.{name}" in fit.effect_values for name in p.effect.on_clock)
    ]


def pays(fitter: Fitter, fit: Fit, fits: Mapping[Key, Fit]) -> bool:
    """Whether each of its causes that are tied to the clock closes more than the fit leaves open, as far as there is a
    fit without it to tell: of the others, or of some of them, for more effects never leave more.
    """
    without = [min((f.cost for f in fits.values() if f.key <= fit.key - {c}), default=math.inf) for c in tied(fit)]
    if all(math.isinf(cost) for cost in without):
        return True
    left = left_open(fitter, fit)
    return left < LEAST or min(without) - fit.cost > left


def paying(fitter: Fitter, some: Iterable[Fit], fits: Mapping[Key, Fit]) -> list[Fit]:
    return [fit for fit in some if pays(fitter, fit, fits)]
