"""Fits of the plant to a recording in which a suspected fault is undone."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

from torch import Tensor

from fdi_torch.gap.preprocess.blockwise_likelihood import (
    BlockedRecording,
    BlockwiseFit,
    blocked_recording,
    blockwise_fit,
    thinned,
)
from fdi_torch.gap.preprocess.first_order_likelihood import FirstOrderLikelihood
from fdi_torch.gap.preprocess.recording_fault_texts import RecordingFault
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording


@dataclass(frozen=True)
class WeightedFault:
    """A fault with its log posterior weight, not normalised."""

    fault: RecordingFault
    log_weight: float


@dataclass(frozen=True)
class Suspicion:
    """A fault that is worth a fit. fault: what it would be; a fit may change its number. weigh: fits it.
    log_weight: log posterior weight to first order in the constants."""

    fault: RecordingFault
    log_weight: float
    weigh: Callable[[], WeightedFault]


@dataclass(frozen=True)
class CorrectedFits:
    """A recording and its corrections.

    as_is: fit without a correction. noise (C,): standard deviation of each sensor's readings as recorded. prior: log
    prior probability of one fault.
    """

    plant: PlantDescription
    recording: Recording
    as_is: BlockwiseFit
    noise: Tensor
    prior: float

    @property
    def thinned(self) -> Recording:
        """The recording with the samples that are fitted."""
        return self.as_is.blocked.recording

    def column(self, sensor: int) -> int:
        """Column of the recording that holds this sensor of the plant."""
        return self.recording.output_names.index(self.plant.sensors[sensor].column)

    def fit(self, corrected: Recording, noise: Tensor | None = None) -> BlockwiseFit:
        """The plant fitted to a corrected recording. noise (C,): of its sensors, if the correction changes it."""
        return blockwise_fit(self._blocked(corrected, noise), base=self.as_is)

    def suspicion(
        self,
        fault: RecordingFault,
        corrected: Recording,
        noise: Tensor | None = None,
        cost: float = 0.0,
        weigh: Callable[[], WeightedFault] | None = None,
    ) -> Iterator[Suspicion]:
        """A fault whose correction is this recording, if its gain to first order exceeds the cost of its prior.

        noise: as in `fit`. cost: subtracted from the log-likelihood. weigh: if one fit to this recording is not enough.
        """
        gain = self.first_order_gain(corrected, noise) - cost

        def by_one_fit() -> WeightedFault:
            return WeightedFault(fault, self.prior + self.fit(corrected, noise).log_likelihood - cost)

        if gain + self.prior > 0.0:
            yield Suspicion(fault, self.as_is.log_likelihood + gain + self.prior, weigh or by_one_fit)

    def first_order_gain(self, corrected: Recording, noise: Tensor | None = None) -> float:
        """Gain in log-likelihood to first order in the constants. noise: as in `fit`.

        The constants have to be free: those of the uncorrected fit were adapted to the wrong recording.
        """
        return self._first_order(self._blocked(corrected, noise)) - self.as_is.log_likelihood

    @cached_property
    def _first_order(self) -> FirstOrderLikelihood:
        return FirstOrderLikelihood(self.as_is)

    def _blocked(self, corrected: Recording, noise: Tensor | None) -> BlockedRecording:
        return blocked_recording(self.plant, thinned(corrected), self.noise if noise is None else noise)

    def channel_log_likelihood(self, sensor: int, residual: Tensor, mask: Tensor) -> float:
        """Log-likelihood of one sensor with these residuals (S,), of which those in the mask (S,) are valid."""
        blocked = self.as_is.blocked
        means, samples = blocked.means(residual.unsqueeze(1), mask.unsqueeze(1))
        mean_square = float((samples * means**2).sum() / samples.sum().clamp(min=1.0))
        return -0.5 * float(self.as_is.means[sensor]) * math.log(max(mean_square, float(blocked.noise[sensor])))
