"""Filter that makes fault-free residuals white with unit variance: random flows, mean and autocorrelation."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.monitor.flow_filter import FlowFilter
from fdi_torch.monitor.flow_noise_estimate import learning_from

HIGHEST_ORDER = 8
FEWEST_SAMPLES = 40


@dataclass(frozen=True)
class Whitening:
    """e_k = W (nu_k - m - sum_j A_j (nu_(k-j) - m)): innovations as a vector autoregression driven by unit white noise.

    nu: innovations of the flow filter `flows`; without one, the residuals themselves. mean m (C,) in the readings'
    units, zero if not significant; coefficients A (order, C, C); whitener W (C, C), lower triangular. samples: number
    that it was estimated from. slow_error (C,): standard error of ln of the standard
    deviation of low-frequency sums of e (1 if the model is exact).
    """

    mean: Tensor
    coefficients: Tensor
    whitener: Tensor
    samples: int
    slow_error: Tensor
    flows: FlowFilter | None = None

    def errors_of_sums(self, length: int) -> tuple[Tensor, Tensor]:
        """Standard errors (C,) of ln of the standard deviation of sums of `length` successive e: by the number of
        samples, and by the uncertain intensities of the random flows.

        For length 1 the first is 1 / sqrt(2 n), with n = `samples`, and the second 0. A longer sum is assumed to be
        much longer than the memory of the autoregression, so that the first is `slow_error`.
        """
        none = torch.zeros_like(self.slow_error)
        if length == 1:
            return none + (2.0 * self.samples) ** -0.5, none
        return self.slow_error, none if self.flows is None else self.flows.error_of_sums(length)

    @property
    def order(self) -> int:
        return len(self.coefficients)

    @property
    def offset(self) -> Tensor:
        """Contribution of the mean to every white residual, W (I - sum A) m, (C,); standard error 1 / sqrt(samples)."""
        eye = torch.eye(len(self.mean), dtype=self.mean.dtype)
        return self.whitener @ (eye - self.coefficients.sum(0)) @ self.mean

    def learning_from(self, residual: Tensor, effects: Tensor, number: int) -> tuple[Whitening, float, float]:
        """The whitening if the random flows are learnt from further residuals (S, C) too, the observer's from `number`
        on, the log-likelihood of all residuals that they were learnt from, and what it gained over the present flows.
        effects (P, S, C): of the errors of constants on these residuals.
        """
        if self.flows is None:
            return self, -0.5 * float(self(residual).square().nansum()), 0.0
        flows, likelihood, gain = learning_from(self.flows, residual, effects, number)
        return replace(self.with_flows(flows), samples=self.samples + len(residual)), likelihood, gain

    def with_flows(self, flows: FlowFilter) -> Whitening:
        """The whitening with other random flows, and with the same ratio of the innovations' standard deviations to
        those that the flow filter predicts.
        """
        before = flows.innovation_std if self.flows is None else self.flows.innovation_std
        return replace(self, whitener=self.whitener * (before / flows.innovation_std), flows=flows)

    def __call__(self, residual: Tensor) -> Tensor:
        """Residuals of a run from its first sample on, scaled to the steady variance (*batch, S, C) -> white
        (*batch, S, C), NaN if one that it depends on is missing.
        """
        return self.of_innovations(self.innovations(residual, states=False)[0])

    def innovations(
        self, residual: Tensor, number: int = 0, memory: Tensor | None = None, states: bool = True
    ) -> tuple[Tensor, Tensor]:
        """Innovations of the flow filter and its memory after each sample; see `FlowFilter.__call__`."""
        if self.flows is None:
            return residual, residual[..., :0]
        return self.flows(residual, number, memory, states)

    def of_innovations(self, innovations: Tensor) -> Tensor:
        """White e of innovations (*batch, S, C), NaN where one is missing, or an earlier one of the same channel on
        which it depends.

        Innovations before the first sample, and missing ones of other channels, are taken to equal their mean.
        """
        deviation = innovations - self.mean
        own = deviation
        for lag, matrix in enumerate(self.coefficients, start=1):
            before = torch.zeros_like(deviation)
            before[..., lag:, :] = deviation[..., :-lag, :]
            unknown = torch.isnan(before)
            moved = own - _apply(matrix, torch.where(unknown, 0.0, before))
            own = torch.where(unknown & (matrix.diagonal() != 0.0), torch.nan, moved)
        missing = torch.isnan(own)
        if not bool(missing.any()):
            return _apply(self.whitener, own)
        lanes, channels = own.reshape(-1, *own.shape[-2:]), own.shape[-1]
        if not bool((missing.reshape(lanes.shape) == missing.reshape(lanes.shape)[0]).all()):
            lanes = lanes.reshape(1, -1, channels)
        white = torch.full_like(lanes, torch.nan)
        patterns, kind = torch.unique(~torch.isnan(lanes[0]), dim=0, return_inverse=True)
        for index, present in enumerate(patterns):
            rows, columns = (kind == index).nonzero(), present.nonzero()[:, 0]
            white[:, rows, columns] = _apply(self._whitener_of(columns), lanes[:, rows, columns])
        return white.reshape(own.shape)

    def _whitener_of(self, columns: Tensor) -> Tensor:
        """The whitener of some channels alone: the inverse Cholesky factor of their own covariance."""
        if len(columns) == len(self.whitener):
            return self.whitener
        factor = torch.linalg.inv(self.whitener)[columns]
        return torch.linalg.inv(torch.linalg.cholesky(factor @ factor.mT))


def score_whitenings(residual: Tensor, highest_order: int = HIGHEST_ORDER) -> list[tuple[float, Whitening]]:
    """(Bayesian information criterion, whitening) for all orders, with and without a mean, best first.

    Channels that are hardly ever read together are modelled separately as white noise. Raises ValueError if the
    recording is too short or a channel does not vary.
    """
    each, known = torch.isfinite(residual).sum(dim=0), torch.isfinite(residual).all(dim=1)
    if int(each.min()) < FEWEST_SAMPLES:
        raise ValueError(
            f"expected at least {FEWEST_SAMPLES} fault-free samples to learn the noise from, got {int(each.min())}; "
            "give a longer recording"
        )
    centred = residual - residual.nanmean(dim=0)
    flat = centred.square().nanmean(dim=0).sqrt() <= 1e-12 * residual.nan_to_num().abs().amax()
    if bool(flat.any()):
        raise ValueError(
            f"expected residuals that vary, got none in channel {int(flat.nonzero()[0]) + 1}: no noise can be learnt "
            "from it; give a recording with measurement noise"
        )
    if int(known.sum()) < FEWEST_SAMPLES:
        return sorted((_apart(residual, mean) for mean in (False, True)), key=lambda fit: fit[0])
    # An order needs ten samples per coefficient, and enough complete consecutive rows.
    highest_order = min(highest_order, int(known.sum()) // (10 * residual.shape[1]))
    while highest_order and 4 * int(known.unfold(0, highest_order + 1, 1).all(dim=1).sum()) < int(known.sum()):
        highest_order -= 1
    fits = [_fit(residual, order, highest_order, mean) for order in range(highest_order + 1) for mean in (False, True)]
    return sorted(fits, key=lambda fit: fit[0])


def _fit(residual: Tensor, order: int, highest: int, with_mean: bool) -> tuple[float, Whitening]:
    """Least squares of r_k on its past, and the BIC over the samples that every order can use."""
    count, channels = residual.shape
    mean = residual.nanmean(dim=0) if with_mean else residual.new_zeros(channels)
    centred = residual - mean
    target = centred[highest:]
    past = [centred[highest - lag : count - lag] for lag in range(1, order + 1)]
    regressors = torch.cat(past, dim=1) if past else target[:, :0]
    usable = torch.isfinite(target).all(1) & torch.isfinite(regressors).all(1)
    target, regressors = target[usable], regressors[usable]
    solution = least_squares(regressors, target)
    error = target - regressors @ solution
    spent = order * channels + int(with_mean)
    covariance = error.mT @ error / max(len(error) - spent, 1)
    matrices = solution.reshape(order, channels, channels).mT
    whitener = torch.linalg.inv(torch.linalg.cholesky(covariance))
    slow = _slow_error(regressors, matrices, whitener, len(error))
    score = len(error) * float(torch.logdet(covariance)) + spent * channels * math.log(len(error))
    return score, Whitening(mean, matrices, whitener, len(error), slow)


def least_squares(rows: Tensor, target: Tensor) -> Tensor:
    """The x (P, C) that minimises |rows x - target|, rows (S, P), target (S, C).

    By QR, because the last bits of `torch.linalg.lstsq` differ from run to run, and with them those of a resumed
    monitor.
    """
    q, r = torch.linalg.qr(rows)
    return torch.linalg.solve_triangular(r, q.mT @ target, upper=True)


def _apart(residual: Tensor, with_mean: bool) -> tuple[float, Whitening]:
    """White noise with a variance per channel, and the BIC over all readings."""
    count, channels = torch.isfinite(residual).sum(dim=0), residual.shape[1]
    mean = residual.nanmean(dim=0) if with_mean else residual.new_zeros(channels)
    variance = (residual - mean).square().nanmean(dim=0)
    score = float((count * variance.log() + int(with_mean) * count.log()).sum())
    none = residual.new_zeros(0, channels, channels)
    return score, Whitening(mean, none, torch.diag(variance.rsqrt()), int(count.min()), (2.0 * count) ** -0.5)


def _slow_error(regressors: Tensor, matrices: Tensor, whitener: Tensor, count: int) -> Tensor:
    """Standard error (C,) of ln of the standard deviation of low-frequency sums of e (delta method).

    It has two parts: 1 / (2 n) from the variance estimate, and the diagonal of W dA(1) (I - A(1))^-1 W^-1 from the
    error of A, where the rows of W dA have the least-squares covariance (X' X)^-1.
    """
    variance = whitener.new_full((len(whitener),), 1.0 / (2.0 * count))
    if not len(matrices):
        return variance.sqrt()
    eye = torch.eye(len(whitener), dtype=whitener.dtype)
    through = torch.linalg.solve(eye - matrices.sum(0), torch.linalg.inv(whitener))  # columns: one for each channel
    direction = through.repeat(len(matrices), 1)
    coefficient_variance = (direction * torch.linalg.solve(regressors.mT @ regressors, direction)).sum(0)
    return (variance + coefficient_variance).sqrt()


def _apply(matrix: Tensor, values: Tensor) -> Tensor:
    """matrix (C, C) times values (..., C) by explicit sums.

    A batch member then does not depend on its neighbours to the last bit, and a missing reading only affects channels
    with a non-zero coefficient.
    """
    columns = ((matrix[:, c], values[..., c : c + 1]) for c in range(values.shape[-1]))
    return sum((torch.where(part == 0.0, 0.0, part * value) for part, value in columns), torch.zeros_like(values))
