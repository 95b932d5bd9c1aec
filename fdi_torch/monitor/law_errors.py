"""Errors that the detector must not take for further faults: of the known faults' sizes and laws, of calibrated
constants, and a steady one.

If fault j has 1 + c_j + a_j(t) times the effect that the model gives it, the white residuals are

    e_k = D_k (c + a_k) + G_k g + b + n_k,    a_{k+1} = phi_k a_k + q_k,    n_k ~ N(0, I).

D_k (sensors, F) is the effect of each fault on them, by finite differences along the readings. The error c of a size is
constant. The error a of a law has the standard deviation ODDS.law_error and an exponential correlation in time. The
errors g of the calibrated constants are constant, with the covariance of their calibration; G_k (sensors, P) is their
effect. The deviation b (sensors,) is zero, or constant and unknown after an answer that leaves more than noise. The
Kalman filter for c, a, g and b turns e_k into innovations that are white with unit variance unless something else
changes.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from fdi_torch.estimate.evidence import ODDS
from fdi_torch.parameters import ParameterSpace
from fdi_torch.simulate.build import BuildError, load_library

SIZE_ERROR = 1.0  # standard deviation of c of a fault whose size the readings since the latest change determine
UNKNOWN = 1e3  # standard deviation of an unknown b, in those of the noise; any value far above residuals gives the same
STEP = 0.01  # of the finite differences, as a share of a fault's effect or of a constant's prior standard deviation


def prior_std(space: ParameterSpace) -> Tensor:
    """Standard deviations (P,) of the parameters' priors; the width of the range where the prior is flat."""
    std, width = space.std(), space.high() - space.low()
    flat = torch.where(torch.isfinite(width), width, space.nominal().abs().clamp(min=1.0))
    return torch.where(torch.isfinite(std), std, flat)


def raised(theta: Tensor, space: ParameterSpace, columns: Sequence[int]) -> Tensor:
    """theta (P,) with each of the columns in turn raised by STEP standard deviations of its prior, (columns, P)."""
    return theta + STEP * torch.diag(prior_std(space))[list(columns)]


@dataclass(frozen=True)
class ConstantErrors:
    """Errors of P constants, in standard deviations of their priors.

    columns (P): of these constants, the `calibrated` ones first. covariance (P, P). mean (P,): zero by default.
    """

    columns: tuple[int, ...] = ()
    covariance: Tensor = field(default_factory=lambda: torch.zeros(0, 0, dtype=torch.float64))
    calibrated: int = 0
    mean: Tensor | None = None


@dataclass(frozen=True)
class LawErrors:
    """What is known about the errors of F faults and P calibrated constants after a sample.

    columns (F): of the faults' sizes. correlation_time: of the errors of their laws, s. state (F + P, order + M),
    memory (F + P, G), innovations (F + P, K, sensors): of observers with one effect, or one constant, raised by STEP,
    the latest K innovations. mean (2 F + P + sensors,) and covariance: of c, a, g and b. constants: their posterior at
    the end of the fault-free part.
    """

    columns: tuple[int, ...]
    correlation_time: float
    state: Tensor
    memory: Tensor
    innovations: Tensor
    mean: Tensor
    covariance: Tensor
    constants: ConstantErrors = field(default_factory=ConstantErrors)

    @classmethod
    def at_start(
        cls,
        columns: Sequence[int],
        correlation_time: float,
        state: Tensor,
        memory: Tensor,
        innovations: Tensor,
        size_errors: Sequence[float] = (),
        constants: ConstantErrors | None = None,
    ) -> LawErrors:
        """The errors at the latest change, before any reading after it; b is zero.

        state (order + M,), memory (G,), innovations (K, sensors): of the observer itself. size_errors (F): standard
        deviations of c, by default SIZE_ERROR. constants: all exact by default. What they have added to the levels
        until then is part of the observer's state.
        """
        f, constants = len(columns), constants or ConstantErrors()
        p = len(constants.columns)
        sizes = state.new_tensor(size_errors) if size_errors else state.new_full((f,), SIZE_ERROR)
        std = torch.cat([sizes, state.new_full((f,), ODDS.law_error), state.new_zeros(p + innovations.shape[-1])])
        state, memory, innovations = (x.expand(f + p, *x.shape) for x in (state, memory, innovations))
        mean, covariance = torch.zeros_like(std), torch.diag(std**2)
        own = cls(tuple(columns), correlation_time, state, memory, innovations, mean, covariance, constants)
        return own.as_calibrated()

    def as_calibrated(self) -> LawErrors:
        """The errors, with those of constants reset to `constants`, what the fault-free part tells about them."""
        own, constants = self._of_constants, self.constants
        mean, covariance = self.mean.clone(), self.covariance.clone()
        mean[own], covariance[own], covariance[:, own] = 0.0, 0.0, 0.0
        mean[own], covariance[own, own] = 0.0 if constants.mean is None else constants.mean, constants.covariance
        return replace(self, mean=mean, covariance=covariance)

    @property
    def _of_constants(self) -> slice:
        return slice(2 * len(self.columns), 2 * len(self.columns) + len(self.constants.columns))

    def as_learnt(self) -> LawErrors:
        """The errors at the end of the fault-free part, as a prior for what follows.

        `constants` already holds what that part tells about the constants that were calibrated on it, so that only the
        errors of the others are updated.
        """
        own, constants, count = self._of_constants, self.constants, self.constants.calibrated
        mean, covariance = self.mean[own].clone(), self.covariance[own, own].clone()
        mean[:count], covariance[:count], covariance[:, :count] = 0.0, 0.0, 0.0
        covariance[:count, :count] = constants.covariance[:count, :count]
        return replace(self, constants=replace(constants, mean=mean, covariance=covariance)).as_calibrated()

    def with_unknown_deviation(self) -> LawErrors:
        """The errors, with nothing known about b from now on."""
        known = 2 * len(self.columns) + len(self.constants.columns)
        mean, covariance = torch.zeros_like(self.mean), torch.zeros_like(self.covariance)
        mean[:known], covariance[:known, :known] = self.mean[:known], self.covariance[:known, :known]
        covariance[known:, known:] = UNKNOWN**2 * torch.eye(len(mean) - known, dtype=mean.dtype)
        return replace(self, mean=mean, covariance=covariance)

    def after(
        self, white: Float[Tensor, "S C"], effects: Float[Tensor, "E S C"], intervals: Float[Tensor, " S"]
    ) -> tuple[LawErrors, Float[Tensor, "S C"]]:
        """The errors after further samples, and the innovations with unit variance, NaN where a reading is missing.

        effects: D and G. intervals: before each sample, s.
        """
        f = len(self.columns)
        if not bool(self.covariance.any()):
            return self, white
        present = torch.isfinite(white)
        of_all = torch.where(present & torch.isfinite(effects), effects, 0.0).permute(1, 2, 0)
        by_errors = torch.cat([of_all[..., :f], of_all, torch.diag_embed(present.to(white.dtype))], dim=2)
        of_law = torch.zeros_like(self.mean)
        of_law[f : 2 * f] = 1.0
        keep = torch.exp(-intervals[:, None] * of_law / self.correlation_time)
        shock = (1.0 - keep.square()) * ODDS.law_error**2
        mean, covariance, rest = _filtered(by_errors, white.nan_to_num(), keep, shock, self.mean, self.covariance)
        return replace(self, mean=mean, covariance=covariance), torch.where(present, rest, torch.nan)


def _filtered(
    effects: Tensor, white: Tensor, keep: Tensor, shock: Tensor, mean: Tensor, covariance: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Mean (M,) and covariance (M, M) of the errors after further samples, and the innovations (S, sensors).

    effects (S, sensors, M); keep, shock (S, M): share of each error that is left after an interval, and added variance.
    """
    try:
        library = _library()
    except BuildError:
        return _filtered_slowly(effects, white, keep, shock, mean, covariance)
    mean, covariance, rest = mean.clone(), covariance.clone(), torch.empty_like(white)
    given = [x.contiguous() for x in (effects, white, keep, shock)]
    pointers = [ctypes.c_void_p(x.data_ptr()) for x in (*given, mean, covariance, rest)]
    library.law_errors(*(ctypes.c_int64(n) for n in effects.shape), *pointers)
    return mean, covariance, rest


def _filtered_slowly(
    effects: Tensor, white: Tensor, keep: Tensor, shock: Tensor, mean: Tensor, covariance: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """`_filtered` without a compiler."""
    rest, eye = torch.empty_like(white), torch.eye(white.shape[1], dtype=white.dtype)
    for k, d in enumerate(effects):
        mean, covariance = keep[k] * mean, keep[k, :, None] * covariance * keep[k] + torch.diag(shock[k])
        root = torch.linalg.cholesky(eye + d @ covariance @ d.mT)
        both = torch.cat([(white[k] - d @ mean)[:, None], d @ covariance], 1)
        scaled = torch.linalg.solve_triangular(root, both, upper=False)
        rest[k], gain = scaled[:, 0], scaled[:, 1:]
        mean, covariance = mean + rest[k] @ gain, covariance - gain.mT @ gain
    return mean, covariance, rest


@lru_cache
def _library() -> ctypes.CDLL:
    """law_errors.hpp, compiled."""
    library = load_library(Path(__file__).with_name("law_errors.hpp").read_text(encoding="utf-8"), "law_errors")
    library.law_errors.restype = None
    return library


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
