"""Likelihood of a recording in which a suspected fault is undone: to first order in the constants, and by a fit."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.gap.preprocess.blockwise_likelihood import (
    ROUNDS,
    BlockedRecording,
    BlockwiseFit,
    blocked_recording,
    blockwise_fit,
    prior_chi_square,
)
from fdi_torch.gap.preprocess.recording_fault_texts import RecordingFault
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording


@dataclass(frozen=True)
class Correction:
    """A recording in which a suspected fault is undone.

    cost: log-likelihood that undoing the fault takes, for its parameter or for readings that are explained without a
    level. noise (C,): standard deviation of each sensor's readings, if undoing the fault changes it. refined: a better
    correction of the same fault, from the fit to this one; None if there is none.
    """

    fault: RecordingFault
    recording: Recording
    cost: float = 0.0
    noise: Tensor | None = None
    refined: Callable[[BlockwiseFit], Correction | None] = lambda fit: None


@dataclass(frozen=True)
class WeighedFault:
    """A fault of a recording, and the fit to the corrected recording. prior: log prior probability less the cost."""

    fault: RecordingFault
    fitted: BlockwiseFit
    prior: float

    @property
    def weight(self) -> float:
        """Log posterior weight, not normalised."""
        return self.prior + self.fitted.log_likelihood

    @property
    def most(self) -> float:
        """The weight of a fit whose residuals are sensor noise only."""
        return self.prior + self.fitted.most


@dataclass(frozen=True)
class CorrectedFits:
    """A recording and its corrections. as_is: fit without one. prior: log prior probability of one fault.

    noise (C,): standard deviation of each sensor's readings as recorded.
    """

    plant: PlantDescription
    recording: Recording
    as_is: BlockwiseFit
    prior: float
    noise: Tensor

    @property
    def thinned(self) -> Recording:
        """The recording with the samples that are fitted."""
        return self.as_is.blocked.recording

    def column(self, sensor: int) -> int:
        """Column of the recording that holds this sensor of the plant."""
        return self.recording.output_names.index(self.plant.sensors[sensor].column)

    def fit(self, corrected: Recording, noise: Tensor | None = None) -> BlockwiseFit:
        """The plant fitted to a corrected recording. noise: as in `Correction`."""
        return blockwise_fit(self._blocked(corrected, noise), base=self.as_is)

    def weighed(self, correction: Correction) -> WeighedFault:
        """A fault, weighed by fits of the corrected recording."""
        fitted = self.fit(correction.recording, correction.noise)
        while better := correction.refined(fitted):
            correction, fitted = better, self.fit(better.recording, better.noise)
        return WeighedFault(correction.fault, fitted, self.prior - correction.cost)

    def first_order_gain(self, correction: Correction) -> float:
        """Gain in log posterior weight to first order in the constants.

        The constants have to be free: those of the uncorrected fit were adapted to the wrong recording.
        """
        corrected = self._blocked(correction.recording, correction.noise)
        gain = first_order_log_likelihood(self.as_is, corrected) - self.as_is.log_likelihood
        return gain - correction.cost + self.prior

    def _blocked(self, corrected: Recording, noise: Tensor | None) -> BlockedRecording:
        return blocked_recording(self.plant, corrected, self.noise if noise is None else noise)

    def channel_log_likelihood(self, sensor: int, residual: Tensor) -> float:
        """Log-likelihood of one sensor with these residuals (S,)."""
        variance = self.as_is.blocked.variance(residual.unsqueeze(1).expand_as(self.as_is.readings))[sensor]
        return -0.5 * float(self.as_is.means[sensor]) * math.log(float(variance))


def first_order_log_likelihood(base: BlockwiseFit, corrected: BlockedRecording) -> float:
    """The log-likelihood of a corrected recording to first order in the constants about the fit to the uncorrected one.

        r_c(theta + s) = r_c - J_c s
        s  maximises  -1/2 sum_c n_c |r_c - J_c s|^2 / (N_c v_c) - chi^2(tolerances) / 2,     v_c of r_c - J_c s

    r_c: residuals of sensor c; J_c: their sensitivities to the constants, those of the fit; N_c: valid samples; v_c and
    n_c as in `blockwise_likelihood.py`, found alternately with s. It costs a fraction of an evaluation of the fit.
    """
    fit, mask = base.fit, corrected.data.mask
    scale, prior, deviation = base.fitter.priors(fit.space, fit.theta)
    residual = corrected.data.readings - _predicted(base, corrected)
    columns = torch.cat([residual.unsqueeze(-1), -fit.linearised.jacobian[0] * scale], dim=-1)  # (S, C, 1 + P)
    columns = torch.where(mask.unsqueeze(-1), columns, 0.0)
    products = torch.einsum("sci,scj->cij", columns, columns)
    block_means, count = corrected.means(columns, mask)  # (B, C, 1 + P)
    means, variance, step = base.means * mask.any(dim=0), base.variance, torch.zeros_like(scale)
    for _ in range(ROUNDS):
        weighted = torch.einsum("c,cij->ij", means / (variance * mask.sum(dim=0).clamp(min=1)), products)
        curvature = weighted[1:, 1:] + torch.diag(prior**2)
        descent = -weighted[1:, 0] - prior * deviation
        step = torch.linalg.lstsq(curvature, descent.unsqueeze(-1), driver="gelsd").solution.squeeze(-1)
        variance = corrected.variance_of_means(block_means[..., 0] + block_means[..., 1:] @ step, count)
    chi_square = prior_chi_square(fit, fit.theta + step * scale)
    return BlockwiseFit(corrected, fit, variance, means, chi_square).log_likelihood


def _predicted(base: BlockwiseFit, corrected: BlockedRecording) -> Tensor:
    """Readings (S, C) that the constants of the fit predict for the inputs of the corrected recording."""
    fit, before, after = base.fit, base.blocked.recording, corrected.recording
    if after.input_names == before.input_names and torch.equal(after.inputs, before.inputs):
        return base.readings
    theta, engine = fit.theta.unsqueeze(0), base.fitter.of(corrected.data).engine(fit.candidate, ())
    return engine.read(engine.trajectories(theta, fit.linearised.levels), theta)[0]
