"""Likelihood of many corrected recordings, each to first order in the constants about one fit.

    r_c(theta + s) = r_c - J_c s
    s  maximises  -1/2 sum_c n_c |r_c - J_c s|^2 / (N_c v_c) - chi^2(tolerances) / 2,     v_c of r_c - J_c s

r_c: residuals of sensor c; J_c: their sensitivities to the constants, those of the fit; N_c: valid samples; v_c and
n_c as in `blockwise_likelihood.py`. The products J_c' J_c and the block means of J_c are common to all corrections that
leave a sensor's valid samples as they are, so that one correction costs a fraction of an evaluation of the fit.
"""

from __future__ import annotations

import torch
from torch import Tensor

from fdi_torch.gap.preprocess.blockwise_likelihood import ROUNDS, BlockedRecording, BlockwiseFit, prior_chi_square


class FirstOrderLikelihood:
    """The log-likelihood of corrected recordings to first order about the fit to the uncorrected one."""

    def __init__(self, base: BlockwiseFit) -> None:
        self.base = base
        self._scale, self._prior, self._deviation = base.fitter.priors(base.fit.space, base.fit.theta)
        self._jacobian = base.fit.linearised.jacobian[0].movedim(1, 0) * self._scale  # (C, S, P)
        self._products = [self._products_of(c, mask) for c, mask in enumerate(base.blocked.data.mask.T)]

    def __call__(self, corrected: BlockedRecording) -> float:
        """The log-likelihood of a corrected recording. Its constants and its v_c are found alternately."""
        base, mask = self.base, corrected.data.mask
        residual = torch.where(mask, corrected.data.readings - self._predicted(corrected), 0.0)
        before = base.blocked.data.mask
        products = [
            of_channel if torch.equal(mask[:, c], before[:, c]) else self._products_of(c, mask[:, c])
            for c, of_channel in enumerate(self._products)
        ]
        curvatures, slopes = (torch.stack(x) for x in zip(*products, strict=True))  # (C, P, P), (C, B, P)
        gradients = (residual.T.unsqueeze(1) @ self._jacobian).squeeze(1)  # (C, P)
        means, count = corrected.means(residual, mask)
        variance, step = base.variance, torch.zeros_like(self._scale)
        for _ in range(ROUNDS):
            weight = base.means.clamp(min=1.0) / (variance * mask.sum(dim=0).clamp(min=1))
            curvature = (weight[:, None, None] * curvatures).sum(0) + torch.diag(self._prior**2)
            descent = weight @ gradients - self._prior * self._deviation
            step = torch.linalg.lstsq(curvature, descent.unsqueeze(-1), driver="gelsd").solution.squeeze(-1)
            variance = corrected.variance_of_means(means - (slopes @ step).T, count)
        chi_square = prior_chi_square(base.fit, base.fit.theta + step * self._scale)
        return BlockwiseFit(corrected, base.fit, variance, base.means, chi_square).log_likelihood

    def _products_of(self, channel: int, mask: Tensor) -> tuple[Tensor, Tensor]:
        """J' J (P, P) of one channel, and the block means (B, P) of J, over the valid samples (S,)."""
        jacobian = self._jacobian[channel] * mask.unsqueeze(-1)
        means, _ = self.base.blocked.means(jacobian, mask.unsqueeze(-1).expand_as(jacobian))
        return jacobian.T @ jacobian, means

    def _predicted(self, corrected: BlockedRecording) -> Tensor:
        """Readings (S, C) that the constants of the fit predict for the inputs of the corrected recording."""
        fit, before, after = self.base.fit, self.base.blocked.recording, corrected.recording
        if after.input_names == before.input_names and torch.equal(after.inputs, before.inputs):
            return fit.linearised.readings[0]
        theta, fitter = fit.theta.unsqueeze(0), self.base.fitter.of(corrected.data)
        engine = fitter.engine(fit.candidate, ())
        return engine.read(engine.trajectories(theta, fit.linearised.levels), theta)[0]
