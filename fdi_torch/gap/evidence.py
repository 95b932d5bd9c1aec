"""How well an explanation stands among others: Laplace's evidence, tempered by what its equations may get wrong.

    log E = -J / (2 T) - log det(H / T) / 2 + sum of the log prior densities of the effects' parameters

J is the fit's chi-square with the tolerances' share, H its curvature. No library has the true equations: an effect with
a slightly other formula leaves a share of the gap that grows with the gap, so T = 1 + min(G / 4000, R / 20) for a gap
of G chi-square units of which the best explanation leaves R open: every further thousandth of the gap left open costs
two nats, however many samples there are; but where the best leaves next to nothing, its equations are right, and what
counts is how many times as much the others leave. Not below G / 200000: five millionths of a gap part nobody.

R is what the plainest good explanation leaves, not what further effects that close a few thousandths of the gap make of
it: what a law misses is of that size, and something can always be found that takes it up.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from fdi_torch.gap.fitting import Fit, Fitter
from fdi_torch.gap.folds import held_out_cost

MISMATCH, MULTIPLES, LEAST = 4000.0, 20.0, 200000.0
FAINT = 2e-3  # share of the gap that a further effect closes, below which it may as well be a law's misfit
SECOND = 0.1  # weight of the second opinion: enough to keep a cause from being named against it
HEARD = 25.0  # nats of evidence behind the best beyond which no second opinion is asked for
LOG_PRIOR_EFFECT = math.log(0.1)  # odds of one more thing being wrong, before the data
# Two effects at one place are mostly one effect there with another equation than the library's.
LOG_PRIOR_SAME_PLACE = math.log(1e-4)


def temperature(gap: float, left: float = math.inf) -> float:
    """gap: chi-square between the recalibrated plant and the best explanation. left: what that leaves open."""
    gap = max(gap, 0.0)
    return 1.0 + min(gap / MISMATCH, max(left, gap / LEAST * MULTIPLES) / MULTIPLES)


def plainest(fits: Sequence[Fit], gap: float) -> Fit:
    """The best of the fits with as few effects as leave only a faint share of the gap to those with more."""
    best = min(f.cost for f in fits)
    for effects in sorted({len(f.key) for f in fits}):
        fit = min((f for f in fits if len(f.key) == effects), key=lambda f: f.cost)
        if fit.cost - best < FAINT * gap:
            return fit
    return min(fits, key=lambda f: f.cost)


def log_evidence(fitter: Fitter, fit: Fit, heat: float, choices: int) -> float:
    """choices: how many effects at places the library holds; each further effect is one of them."""
    space = fit.space
    scale = fitter.box(space)[2]
    curvature = fitter.normal(space, fit.theta.unsqueeze(0), fit.near, scale)[2][0]
    pull = torch.nan_to_num(scale / space.std(fit.theta), posinf=0.0)
    # What a tolerance says is no data and stays as it is.
    hessian = (curvature - torch.diag(pull**2)) / heat + torch.diag(pull**2)
    cost = (fit.cost - _prior_cost(fit)) / heat + _prior_cost(fit)
    widths = torch.tensor([_log_width(fitter, fit, i) for i in range(len(space))], dtype=torch.float64)
    occam = -0.5 * _log_det(hessian) + float((torch.log(scale) - widths).sum())
    return -0.5 * cost + occam + log_prior(fit, choices)


def log_prior(fit: Fit, choices: int) -> float:
    """Before the data: how many effects there are, and which of the choices."""
    causes, places = len(fit.key), len({place for _, place in fit.key})
    each = causes * (LOG_PRIOR_EFFECT - math.log(choices)) + (causes - places) * LOG_PRIOR_SAME_PLACE
    return each + math.lgamma(causes + 1)


def opinions(fitter: Fitter, fits: Sequence[Fit], heat: float, choices: int) -> list[float]:
    """The probability of each fit by its evidence, and to a tenth by what it predicts of stretches unseen.

    Both count the same prior; the second knows no widths of priors and is of less power, but where it is against what
    the evidence says, nothing is beyond doubt.
    """
    evidence = [log_evidence(fitter, fit, heat, choices) for fit in fits]
    top = max(evidence)
    heard = [i for i, e in enumerate(evidence) if e > top - HEARD]
    predicted = [-0.5 * held_out_cost(fitter, fits[i]) / heat + log_prior(fits[i], choices) for i in heard]
    weights = [(1.0 - SECOND) * w for w in posterior(evidence)]
    for i, w in zip(heard, posterior(predicted), strict=True):
        weights[i] += SECOND * w
    return weights


def _prior_cost(fit: Fit) -> float:
    off = (fit.theta - fit.space.nominal(fit.theta)) / fit.space.std(fit.theta)
    return float((off * off).sum())


def _log_width(fitter: Fitter, fit: Fit, i: int) -> float:
    """Log of the width of a parameter's prior over sqrt(2 pi), in its unit."""
    p = fit.space.parameters[i]
    if math.isfinite(p.std):
        return math.log(p.std)
    low, high, _ = fitter.box(fit.space)
    width = float(high[i] - low[i])
    return math.log(width if math.isfinite(width) else 1.0) - 0.5 * math.log(2.0 * math.pi)


def _log_det(h: Tensor) -> float:
    """Of a curvature in units of each parameter's range; what the data do not show counts as known to 1 range."""
    return float(torch.log(torch.clamp(torch.linalg.eigvalsh(h), min=1.0)).sum())


def posterior(log_weights: Sequence[float]) -> list[float]:
    weights = torch.softmax(torch.tensor(log_weights, dtype=torch.float64), dim=0)
    return [float(w) for w in weights]
