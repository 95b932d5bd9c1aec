"""All that the diagnosis of one recording came to, before it is put into numbers and words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from fdi_torch.gap.answer import CauseName, Verdict
from fdi_torch.gap.candidate_fit import Fit, Fitter, unexplained_chi_square
from fdi_torch.gap.posterior import CauseHypothesis, Posterior
from fdi_torch.gap.preprocess.outliers import SensorOutliers
from fdi_torch.gap.search import SearchResult
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.operating_range import OperatingRange

UNEXPLAINED = 0.1  # share of the gap left open at which nothing has been explained


@dataclass(frozen=True)
class DiagnosisResult:
    """sensors: the fitter under the sensors' noise alone. library: what was searched. content: the hypotheses that hold
    95 % together. unnamed: the fit with the free discrepancy of the likeliest hypothesis, if it has one. rounded: what
    the values themselves tell; lattice (C,): the step of each rounded sensor, or 0; told: the limits of sensors, with
    their values; strays: what was masked in the recordings, and in the hold-outs.
    """

    sensors: Fitter
    library: tuple[Placement, ...]
    reach: OperatingRange
    search: SearchResult
    posterior: Posterior
    content: Sequence[CauseHypothesis]
    unnamed: Fit | None
    verdict: Verdict
    rounded: Sequence[CauseName]
    quantization_steps: Sequence[float]
    told: Sequence[Placement] = ()
    strays: tuple[Sequence[SensorOutliers], Sequence[SensorOutliers]] = ((), ())

    @property
    def fitter(self) -> Fitter:
        """Under the noise of the likeliest hypothesis."""
        return self.posterior.best.explanation.fitter

    @property
    def null(self) -> Fit:
        """The recalibrated plant."""
        return self.search.null.fit

    @property
    def named(self) -> Fit:
        """The effects of the likeliest hypothesis."""
        return self.posterior.best.fit

    @property
    def best(self) -> Fit:
        """What explains the recording best: with a name, or without one."""
        return self.unnamed or self.named

    @property
    def gap(self) -> float:
        """What the recalibrated plant leaves open, chi-square units of the sensors' noise."""
        return unexplained_chi_square(self.sensors, self.null)

    @property
    def explained(self) -> bool:
        """Whether the best explanation leaves little of the gap, or little beside the noise."""
        return unexplained_chi_square(self.sensors, self.best) < UNEXPLAINED * max(
            self.gap, float(self.sensors.data.mask.sum())
        )


def chance(found: SearchResult) -> float:
    """That noise alone lets some option of the library gain as much as the best one does (Bonferroni)."""
    gain = float(found.alarm.gain.max())
    return min(1.0, len(found.alarm.options) * math.erfc(math.sqrt(max(gain, 0.0) / 2.0)))
