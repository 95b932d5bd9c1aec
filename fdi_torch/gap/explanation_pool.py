"""Explanations evaluated so far, and how they are extended: screened, fitted, and judged by their evidence.

About an explanation, a first-order regression estimates what every effect of the library would gain (`screening.py`);
the most promising are fitted, and the evidence of the best fits is computed with the noise of sensors and flows
estimated anew.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import torch

from fdi_torch.estimate.evidence import RARE, TOLERANCE
from fdi_torch.estimate.noise_model import StateNoise
from fdi_torch.gap.answer import CauseName
from fdi_torch.gap.candidate import Candidate, Fit, Key
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.extensions import PRIOR_GAIN, ExpectedGain, best_pairs, extended, gain_ratio, log_prior_width
from fdi_torch.gap.marginal_likelihood import (
    evidence_under,
    log_evidence,
    log_prior,
    with_disturbances,
    with_estimated_noise,
    with_likeliest_parameters,
)
from fdi_torch.gap.onsets import with_fine_onsets
from fdi_torch.gap.ranked_explanation import RankedExplanation
from fdi_torch.gap.screening import Option, ScreeningResult, pairs_of, screen
from fdi_torch.gap.stage_progress import StageProgress
from fdi_torch.gap.trajectory_problem import GIVE_UP_DEFICIT, GIVE_UP_SHARE

# BEAM, FITTED, STARTS, EVALUATED and PAIRS are budgets of computing. An extension that FITTED and EVALUATED leave out
# keeps its share of the posterior, `ExplanationPool.unexamined`.
BEAM = 2  # explanations of one size that are extended
FITTED = 8  # effects fitted about each explanation and noise, by first-order gain
STARTS = 8  # initial values of one effect, by first-order gain
EVALUATED = 3  # of these fits, the best whose evidence is computed
PAIRS = 3  # pairs of effects fitted together
EXTENSION = FITTED + EVALUATED  # fits and evaluations about one explanation


class ExplanationPool:
    """The explanations evaluated so far, by their effects.

    fitter: with sensor noise alone. null: the recalibrated plant, fitted by it. choices: number of effects at places in
    the library. progress: counts fits and evaluations.
    """

    def __init__(self, fitter: Fitter, null: Fit, choices: int, progress: StageProgress | None = None) -> None:
        self.fitter, self.null, self.choices = fitter, null, choices
        self.progress = progress or StageProgress()
        self.explanations: dict[Key, RankedExplanation] = {}
        self._expected_gains: dict[Key, dict[Key, ExpectedGain]] = {}
        self._failed: set[Key] = set()

    def evaluate(self, fit: Fit, start: StateNoise | None = None) -> RankedExplanation:
        """Estimate noise and fit alternately until the evidence converges; keep the better explanation.

        Effects that were evaluated before are evaluated again only if this fit is likelier under the noise found then.
        The evaluation stops early if the explanation cannot compete with the likeliest. At its end, improbable onsets
        and the like are dropped. Its fits are given up if they cannot compete with those of as many effects that will
        be extended, or with one that has only some of its effects.
        """
        before, candidate = self.explanations.get(fit.key), fit.candidate
        if before and evidence_under(before.fitter, fit, self.choices) < before.log_evidence + TOLERANCE:
            return before
        rivals = self.best_of(len(fit.key))[BEAM - 1 :] + [e for k, e in self.explanations.items() if k < fit.key]
        rival = max((e.log_evidence for e in rivals), default=-math.inf)
        leader = max((e.log_evidence for e in self.explanations.values()), default=-math.inf)
        best: RankedExplanation | None = None
        climb = False
        while True:
            own_fitter, likely = with_estimated_noise(self.fitter, fit, start, climb)
            here = self._explanation(own_fitter, fit, likely.noise)
            target = here.fit.cost + 2.0 * (here.log_evidence - rival)
            fit = own_fitter.fit(Candidate(candidate.placements, (fit.effect_values,)), here.fit, target)
            # The plant, linearised about the new trajectory, may be another one, in which the fit is less likely.
            there = self._explanation(with_disturbances(self.fitter, fit, likely.noise), fit, likely.noise)
            likelier = min(there, here, key=lambda e: e.negative_log_posterior)
            gain = likelier.log_evidence - best.log_evidence if best else math.inf
            if best is None or gain > 0.0:
                best = likelier
            behind = leader - best.log_evidence
            if behind > 0.5 * GIVE_UP_DEFICIT and gain < GIVE_UP_SHARE * behind:
                break
            if climb and not gain > TOLERANCE:
                fit = with_likeliest_parameters(best.fitter, best.fit, candidate.starts, self.choices)
                best = replace(best, fit=fit, log_evidence=evidence_under(best.fitter, fit, self.choices))
                break
            # The search for the correlation time, which takes longest, begins where the rest has converged.
            climb = not gain > TOLERANCE
            fit, start = (best.fit, best.noise) if climb else (there.fit, there.noise)
        best = replace(best, fit=replace(best.fit, converged=best.fitter.converged(best.fit)))
        if before is None or best.log_evidence > before.log_evidence:
            self.explanations[fit.key] = best
        self.progress.step()
        return best

    def _explanation(self, fitter: Fitter, fit: Fit, noise: StateNoise) -> RankedExplanation:
        """The explanation of a fit under a fitter's noise."""
        fit = replace(fit, cost=fitter.cost(fit))
        return RankedExplanation(fit, fitter, noise, log_evidence(fitter, fit, self.choices))

    def refitted_without(self, explanation: RankedExplanation, cause: CauseName) -> RankedExplanation:
        """The explanation without one of its effects, refitted from its present values.

        A start near the optimum may avoid a local minimum in which an earlier fit of the same effects ended. The refit
        is given up if it does not approach that fit, or this explanation without one.
        """
        fit = explanation.fit
        target = explanation.fitter.cost(self.explanations.get(explanation.key - {cause}, explanation).fit)
        placements = tuple(p for p in fit.candidate.placements if (p.effect.name, p.location) != cause)
        candidate = Candidate(placements, (fit.values_of(placements),))
        self.evaluate(explanation.fitter.fit(candidate, fit, target), explanation.noise)
        return self.explanations[explanation.key - {cause}]

    @property
    def best(self) -> RankedExplanation:
        """The likeliest explanation."""
        return max(self.explanations.values(), key=lambda e: e.log_evidence)

    def best_of(self, effects: int) -> list[RankedExplanation]:
        """Explanations with this number of effects, the likeliest first."""
        return sorted((e for e in self.explanations.values() if len(e.key) == effects), key=lambda e: -e.log_evidence)

    def extend_by(self, parent: RankedExplanation, options: Sequence[Option]) -> None:
        """Extend an explanation by one effect, screened under its own noise."""
        self.extend(parent, screen(parent.fitter, parent.fit, [o for o in options if o.cause not in parent.key]))

    def extend(
        self, parent: RankedExplanation, own_noise: ScreeningResult, sensor_noise: ScreeningResult | None = None
    ) -> None:
        """Extend an explanation by the most promising effects, and by pairs of effects.

        own_noise: screening under its own noise. sensor_noise: screening under sensor noise alone.
        """
        own_noise = with_fine_onsets(parent.fitter, parent.fit, own_noise, FITTED)
        relevant = self._relevant(parent, self._extensions(parent.fit, own_noise, own=True))
        fits = self._fitted(parent.fitter, parent.fit, relevant)[:EVALUATED]
        if sensor_noise:
            pairs = best_pairs(pairs_of(self.fitter, parent.fit, sensor_noise), PAIRS)
            candidates = [*self._extensions(parent.fit, sensor_noise, own=False), *pairs]
            undisturbed = self._fitted(self.fitter, self.null, candidates, (self.fitter.cost(f) for f in fits))
            costs = {parent.key: self.null.cost} | {f.key: f.cost for f in undisturbed}
            fits += [f for f in undisturbed if self._improves(f, costs)][:EVALUATED]
        for fit in sorted(fits, key=lambda f: (len(f.key), -self._prospect(parent, f))):
            self.evaluate(fit, parent.noise)

    def _prospect(self, parent: RankedExplanation, fit: Fit) -> float:
        """Log evidence of a fit under the noise of the sensors alone or that of `parent`, whichever suits it better.

        The likeliest fit is evaluated first, because the others then stop early.
        """
        return max(evidence_under(fitter, fit, self.choices) for fitter in (self.fitter, parent.fitter))

    def fits_beside(self, fitter: Fitter, base: Fit, options: Sequence[Option]) -> list[Fit]:
        """Fits of the most promising extensions of `base` under another noise, and beside a discrepancy.

        base: fit by this fitter. fitter: with the noise that the discrepancy left, and the readings without what it
        explains of them. The own noise of an explanation absorbs what it does not explain, and hides effects of which
        none was fitted.
        """
        further = [o for o in options if o.cause not in base.key]
        screening = with_fine_onsets(fitter, base, screen(fitter, base, further), FITTED)
        candidates = [
            replace(c, starts=(*c.starts, self.explanations[c.key].fit.effect_values))
            if c.key in self.explanations
            else c
            for c in self._extensions(base, screening, own=False)
        ]
        fits = self._fitted(fitter, base, candidates, again=True)[:EVALUATED]
        return [with_likeliest_parameters(fitter, fit, fit.candidate.starts, self.choices) for fit in fits]

    def _fitted(
        self,
        fitter: Fitter,
        base: Fit,
        candidates: Sequence[Candidate],
        rivals: Iterable[float] = (),
        again: bool = False,
    ) -> list[Fit]:
        """Fits of the candidates from `base`, the best first. A fit that is worse than `base` has failed.

        rivals: costs of other fits under the same noise. again: also of those that were evaluated before, under other
        noise.
        """
        cost, fits, least = fitter.cost(base), list[Fit](), min(rivals, default=math.inf)
        for candidate in candidates:
            if again or candidate.key not in self.explanations:
                fit = fitter.fit(candidate, base, least)
                self.progress.step()
                least = min(least, fit.cost)
                if fit.cost < cost:
                    fits.append(fit)
                else:
                    self._failed.add(candidate.key)
        return sorted(fits, key=lambda f: f.cost)

    def _relevant(self, parent: RankedExplanation, extensions: Sequence[Candidate]) -> list[Candidate]:
        """The extensions of `parent` that are expected to come within RARE of the best explanation.

        Each may gain more than its first-order gain by the largest factor among all extensions that were fitted so far.
        """
        pairs = [pair for k in self._expected_gains for pair in self._gains(k)]
        factor = max([1.0, *(actual / gain for actual, gain in pairs if gain > PRIOR_GAIN)])
        needed = math.log(RARE) + self.best.log_evidence - parent.log_evidence
        expected = [(c, self._expected_gains[parent.key][c.key]) for c in extensions]
        return [c for c, e in expected if factor * e.gain + e.prior > needed]

    def _improves(self, fit: Fit, costs: Mapping[Key, float]) -> bool:
        """Whether a fit is likelier, by chi-square and prior odds, than every explanation with fewer of its effects.

        costs: chi-square of each fit under sensor noise alone; under any other noise the gain would be smaller.
        """
        prior = log_prior(fit.key, self.choices)
        return all(
            0.5 * (cost - fit.cost) + prior > log_prior(key, self.choices)
            for key, cost in costs.items()
            if key < fit.key
        )

    def _extensions(self, base: Fit, screening: ScreeningResult, own: bool) -> list[Candidate]:
        """The most promising extensions of an explanation by one effect whose first-order gain exceeds the cost of its
        prior.

        own: whether the screening was made under the explanation's own noise; its expected gains are then recorded.
        """
        by_cause: dict[tuple[str, str], list[int]] = {}
        for i in torch.argsort(screening.gain, descending=True).tolist():
            by_cause.setdefault(screening.options[i].cause, []).append(i)
        candidates: list[Candidate] = []
        for cause, group in by_cause.items():
            key = base.key | {cause}
            odds = log_prior(key, self.choices) - log_prior(base.key, self.choices)
            gain = 0.5 * float(screening.gain[group[0]])
            candidate = extended(base, screening, group[:STARTS])
            if own:
                expected = ExpectedGain(candidate, gain, odds - log_prior_width(screening, group[0]))
                self._expected_gains.setdefault(base.key, {})[key] = expected
            if gain + odds > 0.0 and len(candidates) < FITTED:
                candidates.append(candidate)
        return candidates

    def exchange_effects(self, options: Sequence[Option]) -> None:
        """Remove each effect of the best explanation and try others in its place, while that improves it."""
        while True:
            best = self.best
            for cause in sorted(best.key):
                known = self.explanations.get(best.key - {cause})
                reduced = self.refitted_without(best, cause)
                if reduced is not known and options:
                    self.extend_by(reduced, options)
            if self.best is best:
                return

    def unexamined(self) -> float:
        """Odds of all candidates that were not fitted, against the best explanation."""
        return sum(math.exp(min(lead, 0.0)) for lead, _, _ in self._unfitted())

    def fit_unexamined(self) -> None:
        """Fit and evaluate the likeliest candidates that were not fitted."""
        candidates = [e for e in self._unfitted() if e[2].candidate.key not in self._failed]
        for _, parent, expected in sorted(candidates, key=lambda e: -e[0])[:FITTED]:
            for fit in self._fitted(parent.fitter, parent.fit, [expected.candidate]):
                self.evaluate(fit, parent.noise)

    def _unfitted(self) -> Iterator[tuple[float, RankedExplanation, ExpectedGain]]:
        """Candidates that were not fitted: expected lead in log evidence over the best explanation, parent, and
        expected gain.
        """
        best = self.best
        for key, expected_gains in self._expected_gains.items():
            # The effects of the best explanation, which are true if it is, gain more than others.
            parent, true = self.explanations[key], {key | {cause} for cause in best.key}
            ratio = gain_ratio(self._gains(key, true))
            behind = best.log_evidence - parent.log_evidence
            for k, expected in expected_gains.items():
                if k not in self.explanations:
                    yield ratio * expected.gain + expected.prior - behind, parent, expected

    def _gains(self, key: Key, without: Collection[Key] = ()) -> list[tuple[float, float]]:
        """Actual and first-order gains of the fitted extensions of an explanation."""
        evidence = self.explanations[key].log_evidence
        return [
            (self.explanations[k].log_evidence - evidence - expected.prior, expected.gain)
            for k, expected in self._expected_gains[key].items()
            if k in self.explanations and k not in without
        ]
