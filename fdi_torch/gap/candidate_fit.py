"""Least-squares fit of a candidate, a set of effects at places, to a data set, from many starts at once.

    chi^2(theta) = |W (y - y(theta))|^2 + sum ((theta - nominal) / tolerance)^2

W whitens the residual with the sensor noise and, where there are random flows, with a Kalman filter.
`trajectory_problem.py` minimises this for one candidate.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from fdi_torch.effects import EFFECTS
from fdi_torch.estimate.kalman import KalmanWhitening
from fdi_torch.gap.candidate import Candidate, Fit
from fdi_torch.gap.channel_noise import Noise, low_frequency_excess
from fdi_torch.gap.dataset import DataSet
from fdi_torch.gap.recomputed import Recomputed
from fdi_torch.gap.start_choice import Start, likeliest_starts, vector_of
from fdi_torch.gap.trajectory_problem import MAX_EVALUATIONS, DescentResult, TrajectoryProblem, descend, first_lowest
from fdi_torch.parameters import ParameterSpace, common_name, name_in_recording
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.network import TankNetwork
from fdi_torch.simulate.collocation import Collocation
from fdi_torch.simulate.joint_collocation import JointCollocation
from fdi_torch.simulate.linearised import Linearised

UNDETERMINED = 1e-9  # precision, in units of a parameter's range, that counts as no information


class Fitter:
    """Fits candidates to one data set with one noise model: of the sensors, and of random flows by `whitening`."""

    def __init__(self, data: DataSet, noise: Noise, whitening: Recomputed[KalmanWhitening] | None = None) -> None:
        self.data, self.noise, self._whitening = data, noise, whitening

    @property
    def whitening(self) -> KalmanWhitening | None:
        return self._whitening() if self._whitening else None

    def of(self, data: DataSet) -> Fitter:
        """A fitter of other readings under the same noise."""
        return Fitter(data, self.noise, self._whitening)

    @property
    def log_det(self) -> float:
        """Log determinant of the covariance that `whiten` reduces to the identity, over all readings."""
        return whitening.log_det if (whitening := self.whitening) else self.noise.log_det(self.data.mask)

    def engine(
        self, candidate: Candidate, free: Sequence[str], by: Sequence[str] | None = None
    ) -> Collocation | JointCollocation:
        """The plant with the candidate's effects. Its parameters are the nuisance parameters and those in `free`.

        by: the parameters of effects by which it differentiates; by all parameters by default.
        """
        network = self.network(candidate.placements)
        names = tuple(dict.fromkeys([*self.data.nuisance, *free]))
        space = ParameterSpace(network.constants[n] for n in names if common_name(n) == n)
        if not self.data.further:
            return Collocation(network, space, self.data.experiment, by)
        parts = [Collocation(network, space, part.experiment, by) for part in self.data.parts]
        return JointCollocation(parts, ParameterSpace(replace(space[common_name(n)], name=n) for n in names))

    def network(self, placements: Sequence[Placement]) -> TankNetwork:
        """The plant with these effects added to its nominal effects, or in their place."""
        replaced = {p.prefix for p in placements}
        remaining = [p for p in self.data.nominal_effects if p.prefix not in replaced]
        return TankNetwork(self.data.plant, _in_library_order([*remaining, *placements]))

    def fit(
        self,
        candidate: Candidate,
        base: Fit | None = None,
        target: float = math.inf,
        cap: int = MAX_EVALUATIONS,
        held: Collection[str] = (),
    ) -> Fit:
        """Fit all starts of a candidate and return the best. Nuisance parameters start from `base`.

        target: cost of the competitor; starts that approach it too slowly are given up. cap: maximum number of
        evaluations. held: parameters that keep their initial values.
        """
        by_free: dict[tuple[str, ...], list[Start]] = {}
        for start in self._starts(candidate, base, target):
            by_free.setdefault(start.free, []).append(start)
        fits: list[Fit] = []
        for free, starts in by_free.items():
            fits.append(self._fit(candidate, free, starts, base, min([target, *(f.cost for f in fits)]), cap, held))
        return fits[first_lowest(torch.tensor([f.cost for f in fits], dtype=torch.float64))]

    def _starts(self, candidate: Candidate, base: Fit | None, target: float) -> list[Start]:
        """The starts of a candidate; of those about the base, only the one with the best prospects."""
        starts = [Start(tuple(sorted(s)), s) for s in candidate.starts]
        free = sorted({name for start in starts for name in start.free})
        if base is None or all(name in base.space for name in free):
            return starts
        engine = self.engine(candidate, free, [name for name in free if name not in base.space])
        return likeliest_starts(self, base, engine, starts, target)

    def _fit(
        self,
        candidate: Candidate,
        free: tuple[str, ...],
        starts: Sequence[Start],
        base: Fit | None,
        target: float,
        cap: int,
        held: Collection[str],
    ) -> Fit:
        engine = self.engine(candidate, free)
        initial = base.values if base else self.first_levels()
        theta = torch.stack([vector_of(engine.space, {**initial, **s.values}) for s in starts])
        descents = self.descend(engine, theta, target, cap, held)
        best = first_lowest(descents.cost)
        lane = slice(best, best + 1)
        linearised = descents.linearised.lanes(torch.tensor([best]))
        trajectory = partial(engine.linearise, descents.theta[lane], linearised.origin)
        return Fit(
            candidate,
            engine,
            descents.theta[best],
            float(descents.cost[best]),
            Recomputed(trajectory, linearised),
            bool(descents.converged[best]),
        )

    def first_levels(self) -> dict[str, float]:
        """Initial levels from the mean of the first readings, m, by name."""
        each = [part.first_levels(self.data.plant) for part in self.data.parts]
        return {name_in_recording(name, k): level for k, levels in enumerate(each) for name, level in levels.items()}

    def descend(
        self,
        engine: Collocation | JointCollocation,
        theta: Tensor,
        target: float = math.inf,
        cap: int = MAX_EVALUATIONS,
        held: Collection[str] = (),
    ) -> DescentResult:
        """Least squares from theta (L, P). held: parameters that keep their values."""
        problem, fixed = TrajectoryProblem(self, engine), torch.tensor([n in held for n in engine.space.names])
        low, high, _ = problem.box
        box = torch.where(fixed, theta, low), torch.where(fixed, theta, high)
        return descend(problem, theta, int(self.data.mask.sum()), target, cap, box=box)

    def normal(
        self, space: ParameterSpace, theta: Tensor, residual: Tensor, jacobian: Tensor, scale: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Cost (L,), half its gradient (L, P), and curvature (L, P, P), in scaled parameters.

        residual (L, S, C), jacobian (L, S, C, P): whitened.
        """
        weight = 1.0 / space.std(theta)
        deviation = (theta - space.nominal(theta)) * weight
        j, r = jacobian.permute(0, 2, 3, 1), residual.transpose(1, 2)  # time last
        cost = (r * r).sum((-1, -2)) + (deviation * deviation).sum(-1)
        gradient = scale * ((j @ r.unsqueeze(-1)).sum(1).squeeze(-1) - deviation * weight)
        curvature = scale * scale.unsqueeze(-1) * (j @ j.mT).sum(1) + torch.diag_embed((weight * scale) ** 2)
        return cost, gradient, curvature

    def chi_square(self, space: ParameterSpace, theta: Tensor, residual: Tensor) -> Tensor:
        """Chi-square (L,) of a whitened residual (L, S, C) at theta (L, P), with priors."""
        deviation = (theta - space.nominal(theta)) / space.std(theta)
        return (residual * residual).sum((-1, -2)) + (deviation * deviation).sum(-1)

    def curvature(self, fit: Fit) -> Tensor:
        """Curvature (P, P) of half of chi-square at a fit, in scaled parameters."""
        white, scale = self.white(fit.linearised), self.box(fit.space)[2]
        return self.normal(fit.space, fit.theta.unsqueeze(0), *white, scale)[2][0]

    def cost(self, fit: Fit) -> float:
        """Chi-square of a fit under this fitter's noise, with priors."""
        return float(self.chi_square(fit.space, fit.theta, self.residual(fit.linearised.readings)))

    def converged(self, fit: Fit) -> bool:
        """Whether a fit is at a minimum under this fitter's noise, which may differ from that of its descent."""
        problem = TrajectoryProblem(self, fit.engine)
        return bool(problem.converged(fit.theta.unsqueeze(0), fit.linearised, int(self.data.mask.sum())))

    def white(self, linearised: Linearised) -> tuple[Tensor, Tensor]:
        """Whitened residual (L, S, C) and Jacobian (L, S, C, P)."""
        return self.residual(linearised.readings), self.whiten(linearised.jacobian)

    def residual(self, readings: Tensor) -> Tensor:
        """Whitened residual (L, S, C) of modelled readings (L, S, C)."""
        return self.whiten(self.data.readings - readings)

    def whiten(self, x: Tensor) -> Tensor:
        """Whiten x (*lanes, S, C) or (*lanes, S, C, P): unit variance, no correlation."""
        return whitening(x) if (whitening := self.whitening) else self.noise.whiten(x, self.data.mask)

    def priors(self, space: ParameterSpace, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Scales of the parameters (P,), and their normal priors in these scales: root of the precision (P,), and
        deviation of theta from nominal in standard deviations (P,)."""
        scale, std = self.box(space)[2], space.std(theta)
        return scale, (scale / std).nan_to_num(0.0), ((theta - space.nominal(theta)) / std).nan_to_num(0.0)

    def box(self, space: ParameterSpace) -> tuple[Tensor, Tensor, Tensor]:
        """Lower and upper bounds of the parameters, and the scale on which each varies, (P,) each."""
        low, high, scale = [], [], []
        for p in space:
            timed = p.unit == "s"
            top = min(p.high, self.data.longest_duration) if timed else p.high
            low.append(p.low)
            high.append(max(top, p.nominal))
            finite = math.isfinite(p.std)
            span = top - p.low
            scale.append(p.std if finite else 0.1 * (span if math.isfinite(span) else max(abs(p.nominal), 1.0)))
        return tuple(torch.tensor(x, dtype=torch.float64) for x in (low, high, scale))  # type: ignore[return-value]


def unexplained_chi_square(fitter: Fitter, fit: Fit) -> float:
    """Chi-square that a fit leaves at low frequencies, beyond noise."""
    return max(low_frequency_excess(fitter.residual(fit.linearised.readings)[0]), 0.0)


def _in_library_order(placements: Sequence[Placement]) -> list[Placement]:
    order = {e.name: i for i, e in enumerate(EFFECTS)}
    return sorted(placements, key=lambda p: order.get(p.effect.name, len(order)))


def covariance(fitter: Fitter, fit: Fit, held: Collection[str] = ()) -> Tensor:
    """Covariance (P, P) of a fit's parameters: the inverse of the curvature, priors included.

    held: parameters that count as known.
    """
    scale, widths = fitter.box(fit.space)[2], _widths(fitter, fit)
    # What the readings do not determine must not vanish from the inverse as if it were known exactly.
    curvature = fitter.curvature(fit) + torch.diag(UNDETERMINED * (scale / widths) ** 2)
    free = torch.tensor([n not in held for n in fit.space.names])
    curvature = torch.where(free & free.unsqueeze(1), curvature, 0.0)
    size = torch.sqrt(torch.diagonal(curvature).clamp(min=1e-300))
    correlations = torch.linalg.pinv(curvature / size / size.unsqueeze(1), hermitian=True)
    unit = scale / size
    return correlations * unit * unit.unsqueeze(1)


def standard_errors(fitter: Fitter, fit: Fit) -> dict[str, float]:
    """Standard errors by full name, at most that of a uniform distribution over the parameter's range."""
    errors = torch.sqrt(torch.diagonal(covariance(fitter, fit)).clamp(min=0.0))
    errors = torch.minimum(errors, _widths(fitter, fit) / math.sqrt(12.0))
    return dict(zip(fit.space.names, errors.tolist(), strict=True))


def _widths(fitter: Fitter, fit: Fit) -> Tensor:
    """Widths (P,) of the ranges of a fit's parameters."""
    low, high, _ = fitter.box(fit.space)
    return high - low
