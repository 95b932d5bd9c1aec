"""Errors that the detector must not take for further faults: of the known faults' sizes and laws, and a steady one.

If fault j has 1 + c_j + a_j(t) times the effect that the model gives it, the white residuals are

    e_k = D_k (c + a_k) + b + n_k,    a_{k+1} = phi_k a_k + q_k,    n_k ~ N(0, I).

D_k (sensors, F) is the effect of each fault on them, by finite differences along the readings. The error c of a size is
constant. The error a of a law has the standard deviation ODDS.law_error and an exponential correlation in time. The
deviation b (sensors,) is zero, or constant and unknown after an answer that leaves more than noise. The Kalman filter
for c, a and b turns e_k into innovations that are white with unit variance unless something else changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from fdi_torch.estimate.evidence import ODDS

SIZE_ERROR = 1.0  # standard deviation of c of a fault whose size the readings since the latest change determine
UNKNOWN = 1e3  # standard deviation of an unknown b, in those of the noise; any value far above residuals gives the same
STEP = 0.01  # of the finite differences, as a share of a fault's effect


@dataclass(frozen=True)
class LawErrors:
    """What is known about the errors of F faults after a sample.

    columns (F): of their sizes. correlation_time: of the errors of their laws, s. state (F, order + M), memory (F, G),
    innovations (F, K, sensors): of observers with one effect raised by STEP, the latest K innovations. mean
    (2 F + sensors,) and covariance: of c, a and b.
    """

    columns: tuple[int, ...]
    correlation_time: float
    state: Tensor
    memory: Tensor
    innovations: Tensor
    mean: Tensor
    covariance: Tensor

    @classmethod
    def at_start(
        cls,
        columns: Sequence[int],
        correlation_time: float,
        state: Tensor,
        memory: Tensor,
        innovations: Tensor,
        size_errors: Sequence[float] = (),
    ) -> LawErrors:
        """The errors at the latest change, before any reading after it; b is zero.

        state (order + M,), memory (G,), innovations (K, sensors): of the observer itself. size_errors (F): standard
        deviations of c, by default SIZE_ERROR.
        """
        f = len(columns)
        sizes = state.new_tensor(size_errors) if size_errors else state.new_full((f,), SIZE_ERROR)
        std = torch.cat([sizes, state.new_full((f,), ODDS.law_error), state.new_zeros(innovations.shape[-1])])
        state, memory, innovations = (x.expand(f, *x.shape) for x in (state, memory, innovations))
        mean, covariance = torch.zeros_like(std), torch.diag(std**2)
        return cls(tuple(columns), correlation_time, state, memory, innovations, mean, covariance)

    def with_unknown_deviation(self) -> LawErrors:
        """The same if nothing is known about b from now on."""
        known = 2 * len(self.columns)
        mean, covariance = torch.zeros_like(self.mean), torch.zeros_like(self.covariance)
        mean[:known], covariance[:known, :known] = self.mean[:known], self.covariance[:known, :known]
        covariance[known:, known:] = UNKNOWN**2 * torch.eye(len(mean) - known, dtype=mean.dtype)
        return replace(self, mean=mean, covariance=covariance)

    def after(
        self, white: Float[Tensor, "S C"], effects: Float[Tensor, "F S C"], intervals: Float[Tensor, " S"]
    ) -> tuple[LawErrors, Float[Tensor, "S C"]]:
        """The errors after further samples, and the innovations with unit variance, NaN where a reading is missing.

        effects: D. intervals: before each sample, s.
        """
        f, mean, covariance, rest = len(self.columns), self.mean, self.covariance, torch.empty_like(white)
        if not bool(covariance.any()):
            return self, white
        present, eye = torch.isfinite(white), torch.eye(white.shape[1], dtype=white.dtype)
        of_faults = torch.where(present & torch.isfinite(effects), effects, 0.0).permute(1, 2, 0).repeat(1, 1, 2)
        by_errors = torch.cat([of_faults, torch.diag_embed(present.to(white.dtype))], dim=2)
        of_law = torch.zeros_like(mean)
        of_law[f : 2 * f] = 1.0
        keep = torch.exp(-intervals[:, None] * of_law / self.correlation_time)
        shock = (1.0 - keep.square()) * ODDS.law_error**2
        for k, d in enumerate(by_errors):
            mean, covariance = keep[k] * mean, keep[k, :, None] * covariance * keep[k] + torch.diag(shock[k])
            error = white[k].nan_to_num() - d @ mean
            root = torch.linalg.cholesky(eye + d @ covariance @ d.mT)
            scaled = torch.linalg.solve_triangular(root, torch.cat([error[:, None], d @ covariance], 1), upper=False)
            rest[k], gain = scaled[:, 0], scaled[:, 1:]
            mean, covariance = mean + rest[k] @ gain, covariance - gain.mT @ gain
        return replace(self, mean=mean, covariance=covariance), torch.where(present, rest, torch.nan)


def normalized(residual: Float[Tensor, "T C"], count: int, reach: int) -> Float[Tensor, "S C"]:
    """The last `count` residuals, each divided by the root mean square of the `reach` before it, where that is above 1.

    Far outside the range of its law, such as near the floor of a tank, the error of a known fault is larger still.
    """
    last = residual[-count:]
    before = residual[:-1][-(count + reach - 1) :]
    missing = last.new_full((count + reach - 1 - len(before), last.shape[-1]), torch.nan)
    windows = torch.cat([missing, before]).unfold(0, reach, 1)
    # A cumulative sum adds in the same order however many samples are processed at once.
    total = windows.square().nan_to_num().cumsum(-1)[..., -1]
    return last / (total / torch.isfinite(windows).sum(-1).clamp(min=1)).sqrt().clamp(min=1.0)
