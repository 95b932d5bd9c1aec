"""Profile likelihoods: the best fit for each fixed value of one parameter, and the interval that follows from it.

With f the negative log-likelihood, priors included, the profile of parameter i and its likelihood ratio are

    p(x) = min over theta with theta_i = x of f(theta),    ratio(x) = 2 (p(x) - min f)

and the confidence interval is the range of all x with ratio(x) below the quantile of chi-square with one degree of
freedom (Raue et al. 2009, Bioinformatics 25:1923, equations 6 and 7). Unlike value +- std, the interval follows curved
ridges and ends at bounds. If the true value lies at a bound, its coverage is higher than stated (Self and Liang 1987).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from fdi_torch.estimate.levenberg_marquardt import RefineSettings, levenberg_marquardt
from fdi_torch.estimate.linearisation import Linearise
from fdi_torch.estimate.refinement import CONVERGED_WITHIN, TIGHT_DECREASE
from fdi_torch.estimate.uncertainty import Estimate, chi_square_quantile, plain_value
from fdi_torch.parameters import ParameterSpace
from fdi_torch.tables import Shown, Table, in_display_unit, in_its_units

# Intervals of the first grid; a grid whose end is still inside the interval is extended, each time to twice its reach.
POINTS, MOST_EXTENSIONS = 16, 30
# The first grid reaches this multiple of the half-width that the standard error predicts.
FIRST_REACH = 1.25
# A limit is found when its likelihood ratio is that of the confidence level within this many standard errors.
LIMIT_TOLERANCE, MOST_BISECTIONS = 2e-3, 40
# A restart from a neighbour counts as an improvement above the Newton decrement at which a fit counts as converged.
IMPROVEMENT = 0.5 * CONVERGED_WITHIN**2
SETTINGS = RefineSettings(iterations=200, decrease_tolerance=TIGHT_DECREASE)


SEPARATE = ("theta", "converged", "_made_in")  # not in the JSON of a profile


@dataclass(frozen=True, repr=False)
class Profile(Shown):
    """Profile likelihood of one parameter, SI units.

    x (K,): values at which the parameter was held, ascending. ratio (K,): likelihood ratio. theta (K, P): all
    parameters there. converged (K,) bool: whether that fit converged. value: where the likelihood has its maximum.
    low, high: limits of the interval at `confidence`. ends: 'low', 'high' for limits that are the parameter's bound, or
    beyond which the readings set no limit. improvement: by how much the largest log-likelihood that the profile found
    exceeds that at the estimate.
    """

    name: str
    unit: str
    confidence: float
    value: float
    low: float
    high: float
    ends: tuple[str, ...]
    x: Tensor
    ratio: Tensor
    theta: Tensor
    converged: Tensor
    improvement: float

    @property
    def threshold(self) -> float:
        """Likelihood ratio at the limits."""
        return chi_square_quantile(self.confidence)

    @property
    @in_its_units
    def headline(self) -> str:
        ends = " and ".join(self.ends)
        unit, value, low, high = in_display_unit(self.name, self.unit, self.value, self.low, self.high)
        text = f"{self.name}: {value:.5g}, {100 * self.confidence:g} % interval {low:.5g} … {high:.5g}"
        text = f"{text} {unit.removeprefix('1')}".rstrip() + (f" (bounded only by its range: {ends})" if ends else "")
        return "; ".join([text, *self.warnings])

    @property
    def warnings(self) -> tuple[str, ...]:
        """What makes the interval unreliable, one sentence each."""
        failed = int((~self.converged).sum())
        lines = (
            [f"{failed} of {len(self.x)} fits did not converge, so that the interval may be too narrow"]
            if failed
            else []
        )
        if self.improvement > IMPROVEMENT:
            lines.append(
                f"the estimate is not the best fit: the log-likelihood is {self.improvement:.3g} higher at "
                f"{self.name} = {self.value:.5g}; start the search again with another seed or more evaluations"
            )
        return tuple(lines)

    @in_its_units
    def table(self) -> Table:
        """One row per value of the parameter, in its unit for display."""
        unit, *values = in_display_unit(self.name, self.unit, *self.x.tolist())
        name = self.name if unit == "1" else f"{self.name}, {unit}"
        return Table((name, "likelihood ratio"), [*zip(values, self.ratio.tolist(), strict=True)])

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON; an infinite limit becomes None."""
        plain = {name: plain_value(v, name) for name, v in vars(self).items() if name not in SEPARATE}
        return plain | {"warnings": list(self.warnings)}


def profile_likelihood(
    linearise: Linearise,
    space: ParameterSpace,
    estimate: Estimate,
    names: Iterable[str],
    confidence: float = 0.95,
    *,
    points: int = POINTS,
) -> tuple[Profile, ...]:
    """Profiles of the named parameters about an estimate.

    linearise: negative log-likelihood (L,) with gradient and curvature at theta (L, P), such as `Problem.linearise`.
    points: intervals of the first grid.
    Raises ValueError for an unknown name, a confidence outside (0, 1), and a parameter without scale: an undetermined
    one that has neither a range nor a prior.
    """
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"expected a confidence between 0 and 1, got {confidence:g}; write 0.95 for 95 %")
    indices = [space.index(name) for name in names]
    return tuple(_Profiler(linearise, space, estimate, index, confidence).profile(points) for index in indices)


class _Profiler:
    """The fits of one parameter's profile, sorted by the value at which it was held."""

    def __init__(
        self, linearise: Linearise, space: ParameterSpace, estimate: Estimate, index: int, confidence: float
    ) -> None:
        self.linearise, self.index, self.parameter = linearise, index, space.parameters[index]
        self.confidence, self.threshold = confidence, chi_square_quantile(confidence)
        self.low, self.high = space.low(estimate.value), space.high(estimate.value)
        start = estimate.value[None]
        self.start_cost = float(linearise(start, torch.zeros(1, dtype=torch.int64, device=start.device)).cost)
        self.theta, self.cost, self.converged = self._minimise(start, self.low, self.high)
        column = estimate.covariance[:, index] / estimate.covariance[index, index]
        self.direction = torch.where(torch.isfinite(column), column, 0.0)
        self.scale = self._scale(float(estimate.std[index]))

    def _scale(self, std: float) -> float:
        """Half-width of the first grid: from the standard error, at most the width of the range."""
        p = self.parameter
        scale = min(FIRST_REACH * math.sqrt(self.threshold) * std, p.high - p.low) if std > 0 else p.high - p.low
        if not 0.0 < scale < math.inf:
            raise ValueError(
                f"{p.name}: expected a finite standard error or a range, got neither; give low and high, or std"
            )
        return scale

    @property
    def x(self) -> Tensor:
        return self.theta[:, self.index]

    @property
    def ratio(self) -> Tensor:
        return 2.0 * (self.cost - self.cost.min())

    def profile(self, points: int) -> Profile:
        p, centre = self.parameter, float(self.x[0])
        offsets = self.scale * torch.linspace(-1.0, 1.0, points + 1, dtype=self.x.dtype, device=self.x.device)
        self._fit_from_centre((centre + offsets).clamp(p.low, p.high).unique())
        for side in (-1, 1):
            self._extend(side)
        self._restart_from_neighbours()
        self._fit_freely()
        limits = [self._limit(side) for side in (-1, 1)]
        best = int(self.cost.argmin())
        return Profile(
            name=p.name,
            unit=p.unit,
            confidence=self.confidence,
            value=float(self.x[best]),
            low=limits[0][0],
            high=limits[1][0],
            ends=tuple(end for end, (_, is_open) in zip(("low", "high"), limits, strict=True) if is_open),
            x=self.x,
            ratio=self.ratio,
            theta=self.theta,
            converged=self.converged,
            improvement=self.start_cost - float(self.cost[best]),
        )

    def _fit_from_centre(self, x: Tensor) -> None:
        """Fit at the values x (K,) from the best point, moved along the other parameters' regression on this one."""
        best = self.theta[int(self.cost.argmin())]
        self._add(x, best + (x - best[self.index])[:, None] * self.direction)

    def _fit(self, x: Tensor, start: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Points (K, P), costs (K,) and convergence (K,) of fits from start (K, P), the parameter held at x (K,)."""
        low, high = self.low.expand_as(start).clone(), self.high.expand_as(start).clone()
        low[:, self.index] = high[:, self.index] = x
        return self._minimise(start, low, high)

    def _minimise(self, start: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        fitted = levenberg_marquardt(self.linearise, start.clamp(low, high), low, high, SETTINGS)
        cost = torch.where(torch.isfinite(fitted.cost), fitted.cost, math.inf)
        return fitted.theta, cost, fitted.converged | (fitted.newton_decrement < IMPROVEMENT)

    def _fit_freely(self) -> None:
        """Add the best fit near the best point, if one of another local minimum than the estimate's was found."""
        best = int(self.cost.argmin())
        if float(self.cost[best]) < self.start_cost - IMPROVEMENT:
            self._insert(*self._minimise(self.theta[best, None], self.low, self.high))

    def _add(self, x: Tensor, start: Tensor) -> None:
        """Fit at new values x (K,)."""
        new = ~torch.isin(x, self.x)
        if bool(new.any()):
            self._insert(*self._fit(x[new], start[new]))

    def _insert(self, theta: Tensor, cost: Tensor, converged: Tensor) -> None:
        """Add points (K, P) and sort all by the profiled parameter."""
        self.theta, self.cost = torch.cat([self.theta, theta]), torch.cat([self.cost, cost])
        self.converged = torch.cat([self.converged, converged])
        order = self.x.argsort()
        self.theta, self.cost, self.converged = self.theta[order], self.cost[order], self.converged[order]

    def _extend(self, side: int) -> None:
        """Extend the grid on one side until its end is outside the interval or at the bound."""
        p, reach = self.parameter, self.scale
        bound = p.low if side < 0 else p.high
        for _ in range(MOST_EXTENSIONS):
            end = 0 if side < 0 else -1
            if float(self.ratio[end]) > self.threshold or float(self.x[end]) == bound:
                return
            steps = torch.linspace(0.25, 1.0, 4, dtype=self.x.dtype, device=self.x.device) * side * reach
            x = (self.x[end] + steps).clamp(p.low, p.high).unique()
            self._add(x, self.theta[end].expand(len(x), -1).clone())
            reach *= 2.0

    def _restart_from_neighbours(self) -> None:
        """Fit each point again from its neighbours until no fit improves: a fit may have ended in a local minimum."""
        while len(self.x) > 1:
            improved = False
            for shift in (1, -1):
                start = torch.roll(self.theta, shift, 0)
                theta, cost, converged = self._fit(self.x, start)
                better = cost < self.cost - IMPROVEMENT
                self.theta = torch.where(better[:, None], theta, self.theta)
                self.cost = torch.where(better, cost, self.cost)
                self.converged = torch.where(better, converged, self.converged)
                improved = improved or bool(better.any())
            if not improved:
                return

    def _limit(self, side: int) -> tuple[float, bool]:
        """Limit of the interval on one side, and whether the parameter's range sets it instead of the likelihood."""
        for _ in range(MOST_BISECTIONS):
            inside = (self.ratio <= self.threshold).nonzero().flatten()
            a = int(inside[0] if side < 0 else inside[-1])
            b = a + side
            if not 0 <= b < len(self.x):
                bound = self.parameter.low if side < 0 else self.parameter.high
                return (bound if float(self.x[a]) == bound else side * math.inf), True
            s_a, s_b = (math.sqrt(float(self.ratio[k])) for k in (a, b))
            share = (math.sqrt(self.threshold) - s_a) / (s_b - s_a) if math.isfinite(s_b) else 0.5
            x = (1.0 - share) * self.x[a] + share * self.x[b]
            if min(math.sqrt(self.threshold) - s_a, s_b - math.sqrt(self.threshold)) < LIMIT_TOLERANCE:
                break
            # At least a tenth of the bracket goes at each step, however curved the profile is.
            share = min(max(share, 0.1), 0.9)
            middle = (1.0 - share) * self.theta[a] + share * self.theta[b]
            self._add(middle[None, self.index], middle[None])
        return float(x), False
