"""An explanation with its own noise and its evidence."""

from __future__ import annotations

import math
from dataclasses import dataclass

from fdi_torch.estimate.noise_model import StateNoise
from fdi_torch.gap.candidate import Fit, Key
from fdi_torch.gap.candidate_fit import Fitter


@dataclass(frozen=True)
class RankedExplanation:
    """A set of effects: its fit, the fitter with its own noise, that noise, and its log evidence with prior odds."""

    fit: Fit
    fitter: Fitter
    noise: StateNoise
    log_evidence: float

    @property
    def key(self) -> Key:
        return self.fit.key

    @property
    def negative_log_posterior(self) -> float:
        """-ln of the posterior of the fitted parameters under this noise, up to a constant; infinite if undefined."""
        value = 0.5 * (self.fit.cost + self.fitter.log_det)
        return value if math.isfinite(value) else math.inf

    @property
    def log_weight(self) -> float:
        """Log posterior weight if nothing is unknown: random flows are then of one order of magnitude in all tanks."""
        return self.log_evidence + self.noise.log_prior()
