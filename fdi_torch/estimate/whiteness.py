"""Whether the residuals of a fit are white: the portmanteau test, and what their correlation costs.

With r_k the autocorrelation of the n residuals of a sensor at lag k, and n_k the number of its pairs,

    Q = n (n + 2) sum over k = 1..m of r_k^2 / n_k

has a chi-square distribution with m degrees of freedom if they are white (Ljung and Box 1978, Biometrika 65:297,
equation 1.4). White residuals are all that a complete model leaves of white noise; correlated ones show that the model
lacks something, or that the noise is slow.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

MOST_LAGS, LAGS_PER_READING = 20, 0.05
"""The number m of lags: 20, or a twentieth of the readings."""
SIGNIFICANCE = 1e-3
"""Level of the test, of all sensors of all recordings together."""
WINDOW = 5.0
"""Lags of the integrated autocorrelation time, in units of that time (Sokal 1997, section 3)."""
SLOW_LAGS = 5
"""The correlated share of the variance is the mean of so many autocorrelations. The product of neighbouring residuals
has the variance of the part that changes slowly, since white noise contributes nothing to it."""


def autocorrelations(
    residual: Float[Tensor, "S C"], weight: Float[Tensor, "S C"], lags: int
) -> tuple[Float[Tensor, "K C"], Float[Tensor, "K C"]]:
    """Autocorrelations at lags 1 to `lags` and the numbers of their pairs. weight: 0 masks a residual."""
    valid = weight > 0
    e = torch.where(valid, residual, 0.0)
    square = e.square().sum(0).clamp(min=1e-300)
    steps = range(1, lags + 1)
    r = [(e[k:] * e[:-k]).sum(0) / square for k in steps]
    pairs = [(valid[k:] & valid[:-k]).sum(0) for k in steps]
    return torch.stack(r), torch.stack(pairs).to(e)


def ljung_box(residual: Float[Tensor, "S C"], weight: Float[Tensor, "S C"]) -> Float[Tensor, " C"]:
    """The p-value (C,) of white residuals; 1 for a sensor with too few of them."""
    count = (weight > 0).sum(0)
    lags = min(MOST_LAGS, int(LAGS_PER_READING * float(count.max()))) if len(count) else 0
    if lags < 1:
        return torch.ones_like(residual[0])
    r, pairs = autocorrelations(residual, weight, lags)
    q = count * (count + 2.0) * (r.square() / pairs.clamp(min=1.0)).sum(0)
    p = torch.special.gammaincc(torch.full_like(q, 0.5 * lags), 0.5 * q)
    return torch.where(LAGS_PER_READING * count >= lags, p, 1.0)


def correlated_share(residual: Float[Tensor, "S C"], weight: Float[Tensor, "S C"]) -> Float[Tensor, " C"]:
    """The share (C,) of the residuals' variance that is correlated over several samples."""
    if len(residual) <= SLOW_LAGS:
        return torch.zeros_like(residual[0])
    return autocorrelations(residual, weight, SLOW_LAGS)[0].mean(0).clamp(min=0.0)


def correlation_inflation(
    residual: Float[Tensor, "S C"], weight: Float[Tensor, "S C"], correlated: Bool[Tensor, " C"]
) -> Float[Tensor, " C"]:
    """Variance inflation (C,) of each sensor due to correlated residuals: their spectrum at frequency zero over that of
    white noise of the same variance.

    It is (1 + a) / (1 - a) with a the lag-1 correlation (an AR(1) process, Box & Jenkins 1970); a correlation that is
    negative or within three standard errors of zero counts as zero. Of residuals that are `correlated` by `ljung_box`,
    it is at least the integrated autocorrelation time 1 + 2 sum r_k (Sokal 1997), because a slow misfit below white
    noise has a small lag-1 correlation, but many others as large. residual, weight: (S, C).
    """
    pairs = weight[1:] * weight[:-1]
    square = (weight * residual**2).sum(0) / weight.sum(0).clamp(min=1.0)
    count = pairs.sum(0).clamp(min=1.0)
    a = (pairs * residual[1:] * residual[:-1]).sum(0) / count / square.clamp(min=1e-300)
    a = torch.where(a > 3.0 / torch.sqrt(count), a, torch.zeros_like(a)).clamp(max=1.0 - 20.0 / (count + 20.0))
    inflation = (1.0 + a) / (1.0 - a)
    for c in correlated.nonzero().flatten().tolist():
        time = _integrated_time(residual[:, c, None], weight[:, c, None])
        inflation[c] = inflation[c].clamp(min=min(time, 0.1 * float(count[c])))
    return inflation


def _integrated_time(residual: Float[Tensor, "S one"], weight: Float[Tensor, "S one"]) -> float:
    """Integrated autocorrelation time, in samples, up to the first lag of WINDOW times it."""
    lags = max(len(residual) // 2, 1)
    known = min(MOST_LAGS, lags)
    while True:
        r = autocorrelations(residual, weight, known)[0].flatten()
        times = 1.0 + 2.0 * r.cumsum(0)
        inside = (torch.arange(1, known + 1, device=r.device) >= WINDOW * times).nonzero().flatten()
        if len(inside) or known == lags:
            return float(times[inside[0] if len(inside) else -1])
        known = min(4 * known, lags)
