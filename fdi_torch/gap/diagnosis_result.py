"""The complete result of a diagnosis, from which the answer is built."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from fdi_torch.gap.answer import CauseName, Verdict
from fdi_torch.gap.candidate import Fit
from fdi_torch.gap.candidate_fit import Fitter, unexplained_chi_square
from fdi_torch.gap.cause_hypothesis import CauseHypothesis
from fdi_torch.gap.posterior import Posterior
from fdi_torch.gap.preprocess.outliers import SensorOutliers
from fdi_torch.gap.structure_search import SearchResult
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.operating_range import OperatingRange

UNEXPLAINED = 0.1  # largest share of the gap that may remain if it counts as explained


@dataclass(frozen=True)
class DiagnosisResult:
    """What the stages of a diagnosis found.

    undisturbed: fitter with sensor noise alone. library: the effects searched. operating_range: of the recorded
    signals. credible_set: the fewest hypotheses that have 95 % together. free_form_fit: fit of the free discrepancy, if
    the likeliest hypothesis has an unknown. from_readings: causes that the readings show without a model (quantization,
    limits, stuck sensors, outliers). quantization_steps (C,): 0 where there is none. limits: limits of sensors with
    their values. outliers: masked readings of the recordings, and of the hold-outs.
    """

    undisturbed: Fitter
    library: tuple[Placement, ...]
    operating_range: OperatingRange
    search: SearchResult
    posterior: Posterior
    credible_set: Sequence[CauseHypothesis]
    free_form_fit: Fit | None
    verdict: Verdict
    from_readings: Sequence[CauseName]
    quantization_steps: Sequence[float]
    limits: Sequence[Placement] = ()
    outliers: tuple[Sequence[SensorOutliers], Sequence[SensorOutliers]] = ((), ())

    @property
    def fitter(self) -> Fitter:
        """The fitter with the disturbance noise of the likeliest hypothesis."""
        return self.posterior.best.explanation.fitter

    @property
    def null(self) -> Fit:
        """The recalibrated plant."""
        return self.search.null.fit

    @property
    def effects_fit(self) -> Fit:
        """The fit of the likeliest hypothesis' effects."""
        return self.posterior.best.fit

    @property
    def best(self) -> Fit:
        """The best fit of the recording: with the free discrepancy if there is one."""
        return self.free_form_fit or self.effects_fit

    @property
    def gap(self) -> float:
        """Unexplained chi-square of the recalibrated plant, in units of the sensor noise."""
        return unexplained_chi_square(self.undisturbed, self.null)

    @property
    def explained(self) -> bool:
        """Whether the best fit leaves only a small share of the gap, or little compared with the noise."""
        return unexplained_chi_square(self.undisturbed, self.best) < UNEXPLAINED * max(
            self.gap, float(self.undisturbed.data.mask.sum())
        )

    @property
    def p_value(self) -> float:
        """Probability that noise alone lets some option of the library gain as much as the best one (Bonferroni); 0 if
        the readings themselves show a cause."""
        if self.from_readings:
            return 0.0
        gain = float(self.search.null_screening.gain.max())
        return min(1.0, len(self.search.null_screening.options) * math.erfc(math.sqrt(max(gain, 0.0) / 2.0)))
