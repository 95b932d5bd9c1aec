"""Fits of the plant to a recording in which a suspected fault is undone."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torch import Tensor

from fdi_torch.gap.preprocess.blockwise_likelihood import (
    BlockedRecording,
    BlockwiseFit,
    blocked_recording,
    blockwise_fit,
    first_order_log_likelihood,
    noise_of,
    thinned,
)
from fdi_torch.gap.preprocess.recording_fault_texts import RecordingFault
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording

PRELIMINARY_EVALUATIONS = 3
"""Evaluations of a preliminary fit, which selects the power of ten of an input that gets a full fit. A budget of
computing."""


@dataclass(frozen=True)
class WeightedFault:
    """A fault with its log posterior weight, not normalised."""

    fault: RecordingFault
    log_weight: float


@dataclass(frozen=True)
class CorrectedFits:
    """A recording and its corrections. as_is: fit without a correction. prior: log prior probability of one fault."""

    plant: PlantDescription
    recording: Recording
    as_is: BlockwiseFit
    prior: float

    def column(self, sensor: int) -> int:
        """Column of the recording that holds this sensor of the plant."""
        return self.recording.output_names.index(self.plant.sensors[sensor].column)

    def fit(self, corrected: Recording, preliminary: bool = False) -> BlockwiseFit:
        """The plant fitted to a corrected recording; preliminary: with few evaluations only."""
        blocked = self._blocked(corrected)
        if preliminary:
            return blockwise_fit(blocked, base=self.as_is, cap=PRELIMINARY_EVALUATIONS, rounds=1)
        return blockwise_fit(blocked, base=self.as_is)

    def weighted(self, fault: RecordingFault, corrected: Recording, cost: float = 0.0) -> WeightedFault:
        """A fault whose correction is this recording. cost: subtracted from the log-likelihood."""
        return WeightedFault(fault, self.prior + self.fit(corrected).log_likelihood - cost)

    def first_order_gain(self, corrected: Recording) -> float:
        """Gain in log-likelihood to first order in the constants.

        The constants have to be free: those of the uncorrected fit were adapted to the wrong recording.
        """
        return first_order_log_likelihood(self._blocked(corrected), self.as_is) - self.as_is.log_likelihood

    def worth_fitting(self, gain: float) -> bool:
        """Whether a gain in log-likelihood exceeds the cost of the prior."""
        return gain + self.prior > 0.0

    def _blocked(self, corrected: Recording) -> BlockedRecording:
        return blocked_recording(self.plant, thinned(corrected), noise_of(self.plant, corrected))

    def channel_log_likelihood(self, sensor: int, residual: Tensor, mask: Tensor) -> float:
        """Log-likelihood of one sensor with these residuals (S,), of which those in the mask (S,) are valid."""
        blocked = self.as_is.blocked
        means, samples = blocked.means(residual.unsqueeze(1), mask.unsqueeze(1))
        mean_square = float((samples * means**2).sum() / samples.sum().clamp(min=1.0))
        return -0.5 * float(self.as_is.means[sensor]) * math.log(max(mean_square, float(blocked.noise[sensor])))
