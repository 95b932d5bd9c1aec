"""The decision whether a recording has a fault, such as a wrong unit or a clock offset.

    P(fault) = sum of the weights of all faults / (that sum + weights of the unchanged recording)

The unchanged recording is explained without an effect and with one or two effects of the library, so that an unusual
plant is not mistaken for a wrong recording (two pumps that lag alike look like a late clock). Single effects are fitted
first, because in most recordings one of them explains the gap so well that no fault need be tried. A thorough
examination explains the recording with the likeliest fault undone, and with the likeliest swaps undone, by a single
effect as well, because channels can be swapped where a pipe is plugged. A fault is reported if P(fault) exceeds 95 %.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain, count, islice
from operator import itemgetter

import torch

from fdi_torch.gap.candidate import Candidate
from fdi_torch.gap.library import library_of
from fdi_torch.gap.marginal_likelihood import log_prior
from fdi_torch.gap.preprocess.blockwise_likelihood import BlockwiseFit, blocked_recording, blockwise_fit, noise_of
from fdi_torch.gap.preprocess.corrected_fit import CorrectedFits
from fdi_torch.gap.preprocess.recording_fault_texts import RecordingFault
from fdi_torch.gap.preprocess.recording_faults import DECADES, suspected
from fdi_torch.gap.screening import Option, options_of, screen
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.operating_range import operating_range_of_all, with_simulated_levels
from fdi_torch.recording import Recording

FAULT_PROBABILITY = 0.02
"""Prior probability that the recording has any fault, shared equally by all faults; as that of an effect that the
library lacks (`estimate.evidence.Odds`)."""
SURE = math.log(0.95 / 0.05)
"""Posterior log odds above which a fault is reported."""
EVALUATIONS = 30
"""Maximum number of evaluations of the fit of a rival effect. It limits computing time: a fit that is stopped early
understates the evidence for the rival, so that a fault of the recording is reported more easily."""
RIVALS, MOST_EFFECTS = 6, 2
"""Maximum numbers of rival effects fitted and of effects in one combination; they limit computing time as well."""


@dataclass(frozen=True)
class FaultSearch:
    """The hypotheses about the faults of a recording; their fits are kept, so that a thorough search goes on from them.

    constant: columns of sensors that never move although noise should move them; such a sensor may be stuck, or at a
    limit of its range all the time.
    """

    plant: PlantDescription
    recording: Recording
    constant: tuple[str, ...] = ()
    _rivals: dict[tuple[frozenset[str], float], Rivals] = field(default_factory=dict)

    @cached_property
    def fits(self) -> CorrectedFits:
        """The fit to the recording as it is, and those of corrected recordings."""
        noise, channels = noise_of(self.plant, self.recording), len(self.plant.sensors) + len(self.plant.channels())
        as_is = blockwise_fit(blocked_recording(self.plant, self.recording, noise))
        hypotheses = len(DECADES) * channels + math.comb(channels, 2) + 2 * len(self.plant.sensors) + 1
        return CorrectedFits(self.plant, self.recording, as_is, math.log(FAULT_PROBABILITY / hypotheses), noise)

    def fault(self, thorough: bool = False, explanation: Candidate | None = None) -> RecordingFault | None:
        """The likeliest fault, or None if faults have less than 95 % together.

        thorough: try the likeliest fault beside an effect of the plant too, even if the fault alone gains nothing.
        explanation: effects of the plant that compete as well, with the parameters with which they were fitted.
        """
        fits, as_is = self.fits, self.fits.as_is
        most = as_is.most + fits.prior - SURE  # what a perfect fit of a corrected recording allows the others
        rivals = [as_is.log_likelihood]
        if explanation is not None and most >= as_is.log_likelihood:
            rivals.append(self._weight_of(explanation))
        if most < max(rivals):
            return None
        corrections = suspected(fits, self.constant, thorough)
        if not corrections:
            return None
        silent_columns = {c for _, each in corrections if each.fault.silent for c in each.fault.channels}
        silent = frozenset(s.name for s in self.plant.sensors if s.column in silent_columns)
        others = self._weights_of_effects(silent, as_is.log_likelihood + corrections[0][0] - SURE)
        for rival in islice(others, RIVALS):
            rivals.append(rival)
            if most < rival:
                return None
        faults = [fits.weighed(correction) for _, correction in corrections]
        found = [(each.weight, each.fault) for each in faults]
        best = max(faults, key=lambda each: each.weight)
        if thorough and _log_odds([weight for weight, _ in found], rivals) <= SURE:
            for each in (f for f in faults if f is best or f.fault.swapped):
                if each.most - max(rivals) > SURE:
                    beside = _weights_with_effects(each.fitted, silent, max(rivals) + SURE - each.prior)
                    found += [(each.prior + weight, each.fault) for weight in islice(beside, RIVALS)]
        weights = [weight for weight, _ in found]
        for rival in chain([-math.inf], others):
            rivals.append(rival)
            if _log_odds(weights, rivals) <= SURE:
                return None
        return max(found, key=itemgetter(0))[1]

    def _weights_of_effects(self, excluded: frozenset[str], target: float) -> Iterator[float]:
        """As `_weights_with_effects` of the unchanged recording; those of an earlier call are not fitted again."""
        if (excluded, target) not in self._rivals:
            self._rivals[excluded, target] = Rivals(_weights_with_effects(self.fits.as_is, excluded, target))
        return iter(self._rivals[excluded, target])

    def _weight_of(self, explanation: Candidate) -> float:
        """Log weight of the unchanged recording, fitted with these effects."""
        as_is = self.fits.as_is
        fitted = blockwise_fit(as_is.blocked, explanation, as_is)
        return _log_weight(fitted, as_is, len(library_of(as_is.blocked.plant)))


class Rivals:
    """Values of an iterator that are kept, so that it can be iterated over again."""

    def __init__(self, source: Iterator[float]) -> None:
        self.source, self.kept = source, list[float]()

    def __iter__(self) -> Iterator[float]:
        for k in count():
            if k == len(self.kept):
                try:
                    self.kept.append(next(self.source))
                except StopIteration:
                    return
            yield self.kept[k]


def _log_odds(weights: list[float], rivals: list[float]) -> float:
    """Log posterior odds of some hypotheses against their rivals, from log weights."""
    for_them, against = (torch.logsumexp(torch.tensor(each), 0) for each in (weights, rivals))
    return float(for_them - against)


def _weights_with_effects(as_is: BlockwiseFit, excluded: Collection[str], target: float) -> Iterator[float]:
    """Log weights of a recording, fitted as it is, with one and with two effects of the library, by a greedy search.

    excluded: places at which no effect is tried. target: log-likelihood below which an effect changes no decision.
    """
    blocked, plant, parent = as_is.blocked, as_is.blocked.plant, as_is
    library = [p for p in library_of(plant) if not p.effect.quantizes and p.location not in excluded]
    known = {p.prefix for p in blocked.data.nominal_effects}
    ranges = operating_range_of_all([blocked.recording], plant)
    for _ in range(MOST_EFFECTS):
        fit, fitter = parent.fit, parent.fitter
        operating_range = with_simulated_levels(ranges, plant, fit.linearised.levels[0])
        further = [p for p in library if p.prefix not in known and p.cause not in fit.key]
        screening = screen(fitter, fit, options_of(further, fitter, operating_range))
        best: dict[tuple[str, str], Option] = {}
        for k in torch.argsort(screening.gain, descending=True).tolist():
            best.setdefault(screening.options[k].cause, screening.options[k])
        fits: list[BlockwiseFit] = []
        for option in list(best.values())[:RIVALS]:
            start = fit.effect_values | dict(option.start)
            candidate = Candidate((*fit.candidate.placements, option.placement), (start,))
            fits.append(blockwise_fit(blocked, candidate, as_is, EVALUATIONS, target))
            yield _log_weight(fits[-1], as_is, len(library))
        parent = max(fits, key=lambda each: each.log_likelihood, default=as_is)


def _log_weight(fitted: BlockwiseFit, as_is: BlockwiseFit, choices: int) -> float:
    """Log posterior weight: log-likelihood, half a log n per further effect parameter (BIC), and the log prior.

    as_is: fit with the effects of the plant file only, whose parameters all hypotheses share.
    """
    further = len(fitted.fit.effect_values) - len(as_is.fit.effect_values)
    shape = 0.5 * further * math.log(float(fitted.means.sum()))
    return fitted.log_likelihood - shape + log_prior(fitted.fit.key, choices)
