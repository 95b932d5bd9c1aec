"""Structure search: which sets of effects explain a recording, each judged under the noise that is likely beside it.

A forward search with a beam: about each of the best explanations so far, a regression to first order tells what every
effect of the library promises (screening.py); the most promising are fitted, and the best of the fits are judged by
their evidence, for which the noise of sensors and flows is estimated anew. Last, each effect of the best explanation is
taken away or gives way to another (floating search: Pudil, Novovicova and Kittler, 1994).

The noise of an explanation that lacks a cause is wide, for the cause is random to it, and hides small partners of a
large cause until that is found; without random flows, what another equation misses promises much. So the screen is made
under both.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch

from fdi_torch.estimate.evidence import RARE
from fdi_torch.estimate.kalman import StateNoise
from fdi_torch.gap.answer import CauseName
from fdi_torch.gap.candidate_fit import Candidate, Fit, Fitter, Key
from fdi_torch.gap.marginal_likelihood import log_evidence, log_prior, with_estimated_noise
from fdi_torch.gap.screening import Option, Pairs, ScreeningResult, screen

DEEPEST = 4
BEAM = 2  # explanations of one size that are taken further
FITTED = 8  # effects fitted about each, by what they promise under one noise
STARTS = 2  # of one effect
JUDGED = 3  # fits of those whose evidence is worked out
SETTLED = 0.1  # nats; noise and fit are worked out in turn until the evidence grows by less
TURNS = 4  # rounds in which more of what was not fitted is fitted
KEPT = 3.0  # nats that an effect has to gain to be as likely as not, beside odds of one in twenty
PAIRS = 3  # pairs fitted that promise most together


@dataclass(frozen=True)
class RankedExplanation:
    """A fit, under the fitter with its own noise. log_evidence: prior odds included."""

    fit: Fit
    fitter: Fitter
    noise: StateNoise
    log_evidence: float

    @property
    def key(self) -> Key:
        return self.fit.key


@dataclass(frozen=True)
class SearchResult:
    """explanations: those judged, the likeliest first; null: the recalibrated plant among them. shown: the library
    about the recalibrated plant under the noise of the best explanation; alarm: under its own. unexamined: odds of what
    was not fitted, against the best explanation.
    """

    null: RankedExplanation
    explanations: tuple[RankedExplanation, ...]
    shown: ScreeningResult
    alarm: ScreeningResult
    unexamined: float

    @property
    def best(self) -> RankedExplanation:
        return self.explanations[0]


def search(found: ExplanationPool, null: Fit, options: Sequence[Option], most: int = DEEPEST) -> SearchResult:
    """null: under the sensors' noise alone. most: effects in one explanation."""
    base = found.judge(null)
    alarm = screen(base.fitter, base.fit, options)
    found.extend(base, alarm, screen(found.fitter, base.fit, options))
    frontier = found.best_of(1)[:BEAM]
    for depth in range(2, most + 1):
        if not frontier or frontier[0].log_evidence < found.best_of(depth - 2)[0].log_evidence:
            break
        for parent in frontier:
            found.extend_by(parent, options)
        frontier = found.best_of(depth)[:BEAM]
    found.exchange_effects(options)
    for _ in range(TURNS):
        if found.unexamined() < RARE:
            break
        found.fit_unexamined()
    explanations = sorted(found.each.values(), key=lambda e: -e.log_evidence)
    shown = alarm if explanations[0] is base else screen(explanations[0].fitter, base.fit, options)
    return SearchResult(base, tuple(explanations), shown, alarm, found.unexamined())


class ExplanationPool:
    """The explanations judged so far, by their effects. fitter: under the sensors' noise alone. choices: how many
    effects at places the library holds.
    """

    def __init__(self, fitter: Fitter, choices: int) -> None:
        self.fitter, self.choices = fitter, choices
        self.each: dict[Key, RankedExplanation] = {}
        self._promised: dict[Key, dict[Key, _Promise]] = {}
        self._failed: set[Key] = set()

    def judge(self, fit: Fit, start: StateNoise | None = None) -> RankedExplanation:
        """Works out the noise and the evidence of a fit, which goes on under that noise."""
        judged: RankedExplanation | None = None
        while True:
            own, likely = with_estimated_noise(self.fitter, fit, start, climb=judged is None)
            fit = own.fit(Candidate(fit.candidate.placements, (fit.effect_values,)), fit)
            again = RankedExplanation(fit, own, likely.noise, log_evidence(own, fit, self.choices))
            if judged and not again.log_evidence > judged.log_evidence + SETTLED:
                break
            judged, start = again, likely.noise
        if fit.key not in self.each or judged.log_evidence > self.each[fit.key].log_evidence:
            self.each[fit.key] = judged
        return judged

    def without(self, explanation: RankedExplanation, cause: CauseName) -> RankedExplanation:
        """The explanation without one of its effects, the others begun where they are."""
        fit, key = explanation.fit, explanation.key - {cause}
        if key not in self.each:
            rest = tuple(p for p in fit.candidate.placements if (p.effect.name, p.location) != cause)
            prefixes = {p.prefix for p in rest}
            start = {n: v for n, v in fit.effect_values.items() if n.rpartition(".")[0] in prefixes}
            self.judge(explanation.fitter.fit(Candidate(rest, (start,)), fit), explanation.noise)
        return self.each[key]

    def best_of(self, effects: int) -> list[RankedExplanation]:
        return sorted((e for e in self.each.values() if len(e.key) == effects), key=lambda e: -e.log_evidence)

    def extend_by(self, parent: RankedExplanation, options: Sequence[Option]) -> None:
        """Fits and judges what promises most beside an explanation under its own noise."""
        beside = [o for o in options if o.cause not in parent.key]
        self.extend(parent, screen(parent.fitter, parent.fit, beside, pairs=False))

    def extend(self, parent: RankedExplanation, own: ScreeningResult, still: ScreeningResult | None = None) -> None:
        """Fits and judges what promises most beside an explanation, screened under its own noise, and under that of the
        sensors alone."""
        fits = self._fitted(parent, parent.fitter, self._further(parent, own, own=True))[:JUDGED]
        if still:
            candidates = [*self._further(parent, still, own=False), *_pairs(still.pairs, PAIRS)]
            found = self._fitted(parent, self.fitter, candidates)
            known = {parent.key: self.fitter.cost(parent.fit)} | {f.key: f.cost for f in found}
            fits += [f for f in found if self._pays(f, known)][:JUDGED]
        for fit in sorted(fits, key=lambda f: len(f.key)):
            self.judge(fit, parent.noise)

    def _fitted(self, parent: RankedExplanation, fitter: Fitter, candidates: Sequence[Candidate]) -> list[Fit]:
        """The best first. What ends above the explanation that it contains has failed."""
        known, fits = fitter.cost(parent.fit), list[Fit]()
        for candidate in candidates:
            if candidate.key not in self.each:
                fit = fitter.fit(candidate, parent.fit, min((f.cost for f in fits), default=math.inf))
                if fit.cost < known:
                    fits.append(fit)
                else:
                    self._failed.add(candidate.key)
        return sorted(fits, key=lambda f: f.cost)

    def _pays(self, fit: Fit, known: Mapping[Key, float]) -> bool:
        """Whether an explanation gains over all that it contains what its prior odds cost. known: chi-square of each,
        under the sensors' noise alone: under no other could it gain more.
        """
        prior = log_prior(fit.key, self.choices)
        return all(
            0.5 * (cost - fit.cost) + prior > log_prior(key, self.choices)
            for key, cost in known.items()
            if key < fit.key
        )

    def _further(self, parent: RankedExplanation, found: ScreeningResult, own: bool) -> list[Candidate]:
        """The explanation with one effect more, if what it promises can pay for it: the first few, from their best
        starts."""
        by_cause: dict[tuple[str, str], list[int]] = {}
        for i in torch.argsort(found.gain, descending=True).tolist():
            by_cause.setdefault(found.options[i].cause, []).append(i)
        candidates: list[Candidate] = []
        for cause, group in by_cause.items():
            key = parent.key | {cause}
            odds = log_prior(key, self.choices) - log_prior(parent.key, self.choices)
            gain = 0.5 * float(found.gain[group[0]])
            candidate = _with(parent.fit, found, group[:STARTS])
            if own:
                promise = _Promise(candidate, gain, odds - _spread(found, group[0]))
                self._promised.setdefault(parent.key, {})[key] = promise
            if gain + odds > 0.0 and len(candidates) < FITTED:
                candidates.append(candidate)
        return candidates

    def exchange_effects(self, options: Sequence[Option]) -> None:
        """Takes each effect of the best explanation away, and tries others in its stead, while that is better."""
        while True:
            best = max(self.each.values(), key=lambda e: e.log_evidence)
            for cause in best.key if len(best.key) > 1 else ():
                if best.key - {cause} not in self.each:
                    self.extend_by(self.without(best, cause), options)
            if max(self.each.values(), key=lambda e: e.log_evidence) is best:
                return

    def unexamined(self) -> float:
        """Odds of what was promised less, and so was not fitted, against the best explanation."""
        return sum(math.exp(min(ahead, 0.0)) for ahead, _, _ in self._expected())

    def fit_unexamined(self) -> None:
        """Fits and judges what of the rest is expected to be likeliest."""
        left = [e for e in self._expected() if e[2].candidate.key not in self._failed]
        for _, parent, promise in sorted(left, key=lambda e: -e[0])[:FITTED]:
            for fit in self._fitted(parent, parent.fitter, [promise.candidate]):
                self.judge(fit, parent.noise)

    def _expected(self) -> Iterator[tuple[float, RankedExplanation, _Promise]]:
        """What was not fitted: by how much its log evidence should be ahead of the best, and beside what.

        Fits gain more than they promise, for the noise is narrower beside them: all of those beside one explanation are
        taken to gain in the same proportion as those that were fitted there, without what the best explanation has.
        """
        best = max(self.each.values(), key=lambda e: e.log_evidence)
        for key, promised in self._promised.items():
            parent = self.each[key]
            rivals = [k for k in promised if k in self.each and not k - key <= best.key]
            fitted = [(self.each[k].log_evidence - parent.log_evidence, promised[k]) for k in rivals]
            # Least squares of what was gained on what was promised, beside one fit that kept a promise of KEPT nats.
            gained = KEPT**2 + sum((more - promise.prior) * promise.gain for more, promise in fitted)
            ratio = max(1.0, gained / (KEPT**2 + sum(promise.gain**2 for _, promise in fitted)))
            behind = best.log_evidence - parent.log_evidence
            for k, promise in promised.items():
                if k not in self.each:
                    yield ratio * promise.gain + promise.prior - behind, parent, promise


@dataclass(frozen=True)
class _Promise:
    """An effect more, with what it should gain to first order: nats, before what its prior costs."""

    candidate: Candidate
    gain: float
    prior: float


def _spread(found: ScreeningResult, i: int) -> float:
    """What the size of an option costs, whose prior is as wide as its range: log of the range in standard errors."""
    option = found.options[i]
    name, start = next(iter(option.start.items()))
    size = next(p for p in option.parameters if name.endswith(f".{p.name}"))
    width, unit = size.high - size.low, abs(start - size.nominal)
    if not math.isfinite(width) or unit == 0.0:
        return 0.0
    strength = float(found.strength[i])
    return 0.5 * math.log(max(strength * (width / unit) ** 2 / (2.0 * math.pi), 1.0))


def _with(fit: Fit, found: ScreeningResult, group: Sequence[int]) -> Candidate:
    """The fit with one of the options more; each start once with the size that the screen suggests."""
    starts = [fit.effect_values | sized(found.options[i], float(found.size[i])) for i in group]
    return Candidate((*fit.candidate.placements, found.options[group[0]].placement), tuple(starts))


def sized(option: Option, factor: float) -> dict[str, float]:
    """The start with its size multiplied, within reason; a threshold stays where it was tried."""
    if not option.placement.effect.smooth:
        return dict(option.start)
    name = next(iter(option.start))
    size = next(p for p in option.parameters if name.endswith(f".{p.name}"))
    factor = min(max(factor, 0.1), 4.0)
    value = size.nominal + factor * (option.start[name] - size.nominal)
    return {**option.start, name: min(max(value, size.low), size.high)}


def _pairs(found: Pairs, count: int) -> list[Candidate]:
    """The pairs that promise most together, of causes that alone may promise little."""
    gain = found.gain()
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


def _both(found: Pairs, i: int, j: int) -> dict[str, float]:
    pick = torch.tensor([i, j])
    sizes = torch.linalg.lstsq(found.gram[pick][:, pick], found.score[pick].unsqueeze(1)).solution.flatten().tolist()
    return sized(found.options[i], sizes[0]) | sized(found.options[j], sizes[1])
