"""Which effects: screening, refits of singles, and of combinations one effect at a time.

One effect after the other is taken for what it closes then, and an early one may stand in for what later ones explain
better. So, where no single effect explains much and recalibration went far from what is believed, singles are fitted
once more from the plant as believed, and each effect of the best fit gives way to others in turn (as in floating
selection: Pudil, Novovicova and Kittler, 1994, "Floating search methods in feature selection").
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import torch

from fdi_torch.gap.evidence import temperature
from fdi_torch.gap.fitting import SETTLED, Candidate, Fit, Fitter, Key, left_open
from fdi_torch.gap.screening import Option, Screen, screen
from fdi_torch.gap.tied import paying
from fdi_torch.plant.effect import Placement

SINGLES, STARTS = 14, 2
PARENTS, PARTNERS = 3, 5
DEEPEST = 4
POLISH = 20
PROMISE = 10.0  # chi-square units, of the evidence, that an effect has to promise, to first order, to be fitted
# Of the gap, and chi-square units: what noise alone may leave open. Then only what is beside the best is looked for.
EXPLAINED_SHARE, EXPLAINED_LEAST = 1e-3, 60.0
WORTH_TRYING = 1e-4  # of the gap, that a fit with one effect less leaves more, from which it is tried again
AFRESH = 0.1  # of the gap left open by the best single, from which singles begin once more at the plant as believed
HOPELESS = 0.5  # of the gap left open by the best pair, at which a third effect will not explain it either
SWAPS, SUBSTITUTES = 3, 3  # rounds in which effects give way to others, and how many others are tried for each
FAR_OFF = 2.0  # tolerances off its nominal, from which a recalibrated constant may have taken up what an effect does
SETTLED_SHARE = 0.02  # of the gap left open by the best single, below which lesser promises are not followed


@dataclass(frozen=True)
class Search:
    """All fits made, best first; screens by the key of the fit they were made about."""

    null: Fit
    fits: tuple[Fit, ...]
    screens: dict[Key, Screen]

    @property
    def best(self) -> Fit:
        return self.fits[0]


def search(fitter: Fitter, null: Fit, options: Sequence[Option], most: int = DEEPEST) -> Search:
    """Fits singles, then pairs and more (`most`) about the best ones, while another effect promises something."""
    fits: dict[Key, Fit] = {null.key: null}
    screens = {null.key: screen(fitter, null, options)}
    settled = SETTLED * temperature(left_open(fitter, null))
    singles = _further(null, screens[null.key], SINGLES, PROMISE)
    for candidate in singles:
        if not _outdone(fitter, null, _best(fits), candidate.promise):
            _keep(fits, fitter.fit(candidate, null, target=_best(fits), settled=settled))
    left, gap = _open(fitter, null, fits)
    hidden = left > AFRESH * gap and _far_off(null)
    if hidden:
        believed = fitter.fit(Candidate(), rounds=0)
        for candidate in singles:
            _keep(fits, fitter.fit(_from_all(candidate, options), believed, settled=settled))
    _polish(fitter, fits, 1)
    for depth in range(2, most + 1):
        before = len(fits)
        heat = temperature(null.cost - _best(fits))
        left, gap = _open(fitter, null, fits)
        if depth > 2 and left > HOPELESS * gap:
            break
        explained = left < max(EXPLAINED_SHARE * gap, min(EXPLAINED_LEAST, 0.1 * gap))
        followed, count = _followed(fitter, fits, depth - 1), 1 if explained else PARENTS if depth == 2 else 2
        for parent in _parents(followed, depth - 1, count):
            screens[parent.key] = screen(fitter, parent, _beside(parent, options), heat, pairs=False)
            for candidate in _further(parent, screens[parent.key], PARTNERS if depth == 2 else 3, PROMISE):
                if _untried(fits, candidate, parent):
                    _keep(fits, fitter.fit(candidate, parent, target=_best(fits), settled=settled))
        if depth == 2 and len(fits) > before and not explained:
            for candidate in _pairs(screens[null.key], 3):
                if candidate.key not in fits:
                    _keep(fits, fitter.fit(candidate, null, target=_best(fits), settled=settled))
        if len(fits) == before:
            break
        _polish(fitter, fits, depth)
        if hidden and left > SETTLED_SHARE * gap:
            _swap(fitter, fits, screens, options, depth, settled)
    _without_one(fitter, fits, settled)
    return Search(null, tuple(sorted(paying(fitter, fits.values(), fits), key=lambda f: f.cost)), screens)


def _followed(fitter: Fitter, fits: dict[Key, Fit], effects: int) -> list[Fit]:
    """The fits of so many effects from which others follow. From three on, what is tied to the clock has to pay: with
    fewer, what it has to close beside may only not have been found yet.
    """
    some = [f for f in fits.values() if len(f.key) == effects]
    return (paying(fitter, some, fits) if effects > 2 else []) or some


def _far_off(null: Fit) -> bool:
    """Whether recalibration went far from what is believed: constants that took up an effect's work may keep its fit
    from finding it.
    """
    off = (null.theta - null.space.nominal(null.theta)) / null.space.std(null.theta)
    return float(off.abs().max()) > FAR_OFF


def _from_all(candidate: Candidate, options: Sequence[Option]) -> Candidate:
    """A single from every start of its cause: a screen tells the good ones only near where it was made."""
    return replace(candidate, starts=tuple(o.start for o in options if {o.cause} == candidate.key))


def _untried(fits: dict[Key, Fit], candidate: Candidate, parent: Fit) -> bool:
    """Whether there is no such fit yet, or one that went astray: with an effect more it leaves more."""
    return candidate.key not in fits or fits[candidate.key].cost > parent.cost


def _swap(
    fitter: Fitter,
    fits: dict[Key, Fit],
    screens: dict[Key, Screen],
    options: Sequence[Option],
    depth: int,
    settled: float,
) -> None:
    """Each effect of the best fit of so many gives way in turn to those that promise most in its stead, until none is
    better.
    """
    null = fits[frozenset()]
    for _ in range(SWAPS):
        (best,) = _parents(_followed(fitter, fits, depth), depth, 1)
        heat = temperature(null.cost - best.cost, left_open(fitter, best))
        for left in best.candidate.placements:
            rest = _less(fitter, fits, best, left, settled)
            screens[rest.key] = screen(fitter, rest, _beside(best, options), heat, pairs=False)
            for candidate in _further(rest, screens[rest.key], SUBSTITUTES, PROMISE):
                if _untried(fits, candidate, rest):
                    _keep(fits, fitter.fit(candidate, rest, target=_best(fits), settled=settled))
        if best.cost - _best(fits) < WORTH_TRYING * (null.cost - best.cost):
            break
        _polish(fitter, fits, depth)


def _without_one(fitter: Fitter, fits: dict[Key, Fit], settled: float) -> None:
    """Each effect of the best fits taken away in turn, the others from where they are: what was found only beside an
    effect that does nothing is found without it too.
    """
    for depth in range(max(len(key) for key in fits), 1, -1):
        for fit in _parents(fits.values(), depth, 1):
            for left in fit.candidate.placements:
                _less(fitter, fits, fit, left, settled)


def _less(fitter: Fitter, fits: dict[Key, Fit], fit: Fit, left: Placement, settled: float) -> Fit:
    """The fit without one of its effects, the others from where they are; a known one where that is as good."""
    rest = tuple(p for p in fit.candidate.placements if p is not left)
    start = {n: v for n, v in fit.effect_values.items() if n.rpartition(".")[0] != left.prefix}
    key = fit.key - {(left.effect.name, left.location)}
    known = fits.get(key)
    if known is None or known.cost > fit.cost + WORTH_TRYING * (fits[frozenset()].cost - fit.cost):
        _keep(fits, fitter.fit(Candidate(rest, (start,)), fit, target=_best(fits), settled=settled))
    return fits[key]


def _polish(fitter: Fitter, fits: dict[Key, Fit], effects: int) -> None:
    """The two best fits of so many effects go on to where they end: thresholds come to rest slowly."""
    null, best = fits[frozenset()], min(fits.values(), key=lambda f: f.cost)
    settled = SETTLED * temperature(null.cost - best.cost, left_open(fitter, best))
    for fit in _parents(fits.values(), effects, 2):
        again = Candidate(fit.candidate.placements, (fit.effect_values,))
        _keep(fits, fitter.fit(again, fit, rounds=POLISH, settled=settled))


def _open(fitter: Fitter, null: Fit, fits: dict[Key, Fit]) -> tuple[float, float]:
    """What the best fit leaves open, and the whole gap, chi-square units."""
    best = min(fits.values(), key=lambda f: f.cost)
    left = left_open(fitter, best)
    return left, null.cost - best.cost + left


def _outdone(fitter: Fitter, null: Fit, best: float, promise: float) -> bool:
    """Whether another effect alone has closed all but a little, and this one promises not half as much."""
    dof = float(fitter.subject.mask.sum())
    return best - dof < SETTLED_SHARE * (null.cost - dof) and promise < 0.5 * (null.cost - best)


def _best(fits: dict[Key, Fit]) -> float:
    return min(f.cost for f in fits.values())


def _keep(fits: dict[Key, Fit], fit: Fit) -> None:
    if fit.key not in fits or fit.cost < fits[fit.key].cost:
        fits[fit.key] = fit


def _parents(fits: Iterable[Fit], effects: int, count: int) -> list[Fit]:
    return sorted((f for f in fits if len(f.key) == effects), key=lambda f: f.cost)[:count]


def _beside(fit: Fit, options: Sequence[Option]) -> list[Option]:
    return [o for o in options if o.cause not in fit.key]


def _further(fit: Fit, found: Screen, count: int, worth: float) -> list[Candidate]:
    """The fit with one more effect: the `count` causes that promise most, each from its best starts."""
    by_cause: dict[tuple[str, str], list[int]] = {}
    for i in torch.argsort(found.gain, descending=True).tolist():
        if float(found.gain[i]) > worth:
            by_cause.setdefault(found.options[i].cause, []).append(i)
    chosen = list(by_cause.values())[:count]
    kept = [[i for i in group[:STARTS] if found.gain[i] > 0.3 * found.gain[group[0]]] for group in chosen]
    return [_with(fit, [found.options[i] for i in group], found, group) for group in kept]


def _with(fit: Fit, options: Sequence[Option], found: Screen, group: Sequence[int]) -> Candidate:
    """Each start once with the size that the screen suggests, the rest where the fit has it."""
    starts = [fit.effect_values | sized(o, float(found.size[i])) for o, i in zip(options, group, strict=False)]
    promise = float(found.gain[group[0]])
    return Candidate((*fit.candidate.placements, options[0].placement), tuple(starts), promise)


def sized(option: Option, factor: float) -> dict[str, float]:
    """The start with its size multiplied, within reason; a threshold stays where it was tried."""
    if not option.placement.effect.smooth:
        return dict(option.start)
    name = next(iter(option.start))
    size = next(p for p in option.parameters if name.endswith(f".{p.name}"))
    factor = min(max(factor, 0.1), 4.0)
    value = size.nominal + factor * (option.start[name] - size.nominal)
    return {**option.start, name: min(max(value, size.low), size.high)}


def _pairs(found: Screen, count: int) -> list[Candidate]:
    """The pairs that promise most together, of causes that alone may promise little."""
    gain = found.pair_gain()
    best: dict[Key, tuple[int, int]] = {}
    order = torch.argsort(gain.flatten(), descending=True)[:400].tolist()
    for flat in order:
        i, j = divmod(flat, gain.shape[1])
        a, b = found.options[i], found.options[j]
        if a.cause != b.cause:
            best.setdefault(frozenset((a.cause, b.cause)), (i, j))
    return [
        Candidate((found.options[i].placement, found.options[j].placement), (_both(found, i, j),))
        for i, j in list(best.values())[:count]
    ]


def _both(found: Screen, i: int, j: int) -> dict[str, float]:
    pick = torch.tensor([i, j])
    sizes = torch.linalg.lstsq(found.gram[pick][:, pick], found.score[pick].unsqueeze(1)).solution.flatten().tolist()
    return sized(found.options[i], sizes[0]) | sized(found.options[j], sizes[1])
