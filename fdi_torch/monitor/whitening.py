"""The level and colour of fault-free residuals, and their removal: what is left is white and of unit spread."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

HIGHEST_ORDER = 8
FEWEST_SAMPLES = 40
BLOCKS = (10, 30, 100, 300)  # samples; a CUSUM sums over some tens, a fit over some hundreds
FEWEST_BLOCKS, PRIOR_BLOCKS = 6, 5


@dataclass(frozen=True)
class Whitening:
    """e_k = W (r_k - m - sum_j A_j (r_(k-j) - m)): residuals as a vector autoregression driven by unit white noise.

    mean m (C,) in the readings' units, zero where the recording shows none; coefficients A (order, C, C);
    whitener W (C, C), lower triangular. samples: how many it was estimated from. slow_error (C,): standard error of
    ln of the standard deviation that slow sums of e have, which is 1 where the colour is known. slow (C,): variance of
    slow sums that the autoregression left, over that of white noise, which W makes up for: e has variance 1 / slow.
    """

    mean: Tensor
    coefficients: Tensor
    whitener: Tensor
    samples: int
    slow_error: Tensor
    slow: Tensor | None = None

    @property
    def level(self) -> float:
        """Mean square of e without a fault."""
        return 1.0 if self.slow is None else float((1.0 / self.slow).mean())

    @property
    def fast_error(self) -> float:
        """Standard error of ln of the standard deviation of single e: 1 / sqrt(2 n)."""
        return (2.0 * self.samples) ** -0.5

    @property
    def order(self) -> int:
        return len(self.coefficients)

    @property
    def offset(self) -> Tensor:
        """What the mean alone adds to every white residual, W (I - sum A) m, (C,); known to 1 / sqrt(samples)."""
        eye = torch.eye(len(self.mean), dtype=self.mean.dtype)
        return self.whitener @ (eye - self.coefficients.sum(0)) @ self.mean

    def __call__(self, residual: Tensor) -> Tensor:
        """residual (*batch, S, C) -> white (*batch, S, C), NaN where it, or one before it that counts, is missing."""
        return self.filter(residual - self.mean)

    def filter(self, residual: Tensor) -> Tensor:
        """The same without the mean: what a fault adds to the residual -> what it adds to the white residual.

        Nothing is known before the first sample; it counts as zero there.
        """
        rest = residual
        for lag, matrix in enumerate(self.coefficients, start=1):
            before = torch.zeros_like(residual)
            before[..., lag:, :] = residual[..., :-lag, :]
            rest = rest - _apply(matrix, before)
        return _apply(self.whitener, rest)


def fit_whitening(residual: Tensor, highest_order: int = HIGHEST_ORDER) -> Whitening:
    """From the residuals (S, C) of one fault-free recording; order and mean by the Bayesian information criterion."""
    return score_whitenings(residual, highest_order)[0][1]


def with_slow_variance(whitening: Whitening, residual: Tensor) -> Whitening:
    """With a whitener that allows for slow disturbances, as far as residuals (S, C) show them.

    The variance of means over blocks of m samples, times m, is 1 where e is white and more where it varies slowly: what
    an autoregression of a few samples cannot see. Of the block lengths BLOCKS the worst counts, each drawn towards 1 as
    if PRIOR_BLOCKS blocks of white noise had been seen as well.
    """
    white = whitening(residual)[whitening.order :]
    slow = torch.ones(white.shape[-1], dtype=white.dtype)
    for length in BLOCKS:
        count = len(white) // length
        if count < FEWEST_BLOCKS:
            break
        blocks = white[: count * length].reshape(count, length, -1)
        seen = torch.isfinite(blocks).sum(1).clamp(min=1)
        square = (torch.nan_to_num(blocks).sum(1).square() / seen).sum(0)
        slow = torch.maximum(slow, (square + PRIOR_BLOCKS) / (count + PRIOR_BLOCKS))
    return replace(whitening, whitener=whitening.whitener / slow.sqrt().unsqueeze(1), slow=slow)


def score_whitenings(residual: Tensor, highest_order: int = HIGHEST_ORDER) -> list[tuple[float, Whitening]]:
    """Whitenings of residuals (S, C) of all orders with and without a mean, and their Bayesian information criterion,
    best first.

    Where the channels are hardly ever read together each is taken for itself, without colour.
    Raises ValueError where the recording is too short, or a channel does not vary.
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
    # An order needs ten samples for each of its coefficients, and rows that follow each other.
    highest_order = min(highest_order, int(known.sum()) // (10 * residual.shape[1]))
    while highest_order and 4 * int(known.unfold(0, highest_order + 1, 1).all(dim=1).sum()) < int(known.sum()):
        highest_order -= 1
    fits = [_fit(residual, order, highest_order, mean) for order in range(highest_order + 1) for mean in (False, True)]
    return sorted(fits, key=lambda fit: fit[0])


def _fit(residual: Tensor, order: int, highest: int, with_mean: bool) -> tuple[float, Whitening]:
    """Least squares of r_k on its past, and its BIC over the samples that every order can use."""
    count, channels = residual.shape
    mean = residual.nanmean(dim=0) if with_mean else residual.new_zeros(channels)
    centred = residual - mean
    target = centred[highest:]
    past = [centred[highest - lag : count - lag] for lag in range(1, order + 1)]
    regressors = torch.cat(past, dim=1) if past else target[:, :0]
    usable = torch.isfinite(target).all(1) & torch.isfinite(regressors).all(1)
    target, regressors = target[usable], regressors[usable]
    solution = torch.linalg.lstsq(regressors, target).solution if order else regressors.new_zeros(0, channels)
    error = target - regressors @ solution
    spent = order * channels + int(with_mean)
    covariance = error.mT @ error / max(len(error) - spent, 1)
    matrices = solution.reshape(order, channels, channels).mT
    whitener = torch.linalg.inv(torch.linalg.cholesky(covariance))
    slow = _slow_error(regressors, matrices, whitener, len(error))
    score = len(error) * float(torch.logdet(covariance)) + spent * channels * math.log(len(error))
    return score, Whitening(mean, matrices, whitener, len(error), slow)


def _apart(residual: Tensor, with_mean: bool) -> tuple[float, Whitening]:
    """Each channel's own spread, and the criterion over all readings."""
    count, channels = torch.isfinite(residual).sum(dim=0), residual.shape[1]
    mean = residual.nanmean(dim=0) if with_mean else residual.new_zeros(channels)
    variance = (residual - mean).square().nanmean(dim=0)
    score = float((count * variance.log() + int(with_mean) * count.log()).sum())
    none = residual.new_zeros(0, channels, channels)
    return score, Whitening(mean, none, torch.diag(variance.rsqrt()), int(count.min()), (2.0 * count) ** -0.5)


def _slow_error(regressors: Tensor, matrices: Tensor, whitener: Tensor, count: int) -> Tensor:
    """What errors of A do to slow sums of e: W dA(1) (I - A(1))^-1 W^-1 on its diagonal, rows of W dA having the least
    squares covariance (X' X)^-1, beside 1 / (2 n) of the spread itself (delta method).
    """
    own = whitener.new_full((len(whitener),), 1.0 / (2.0 * count))
    if not len(matrices):
        return own.sqrt()
    eye = torch.eye(len(whitener), dtype=whitener.dtype)
    through = torch.linalg.solve(eye - matrices.sum(0), torch.linalg.inv(whitener))  # columns: one for each channel
    direction = through.repeat(len(matrices), 1)
    spread = (direction * torch.linalg.solve(regressors.mT @ regressors, direction)).sum(0)
    return (own + spread).sqrt()


def _apply(matrix: Tensor, values: Tensor) -> Tensor:
    """matrix (C, C) times values (..., C) as explicit sums, so that a lane does not depend on its neighbours, nor a
    channel on the missing reading of another that has no part in it.
    """
    columns = ((matrix[:, c], values[..., c : c + 1]) for c in range(values.shape[-1]))
    return sum((torch.where(part == 0.0, 0.0, part * value) for part, value in columns), torch.zeros_like(values))
