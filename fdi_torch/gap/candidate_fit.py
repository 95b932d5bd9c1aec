"""Fits of one model, from many starts at once, to one recording: least squares on whole trajectories.

The collocation corrects a trajectory by one Newton step per evaluation. Costs of two points are therefore compared only
where both trajectories obey the model: a point whose trajectory does not settle is refused.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.effects import EFFECTS
from fdi_torch.estimate.kalman import KalmanWhitening
from fdi_torch.estimate.levenberg_marquardt import Competition, RefineSettings, levenberg_marquardt
from fdi_torch.gap.dataset import DataSet, RecordingPart, interpolate
from fdi_torch.gap.noise_model import Noise, low_frequency_excess
from fdi_torch.gap.trajectory_problem import FAR, TrajectoryProblem
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.scales import length_scale
from fdi_torch.simulate.collocation import Collocation, Linearised
from fdi_torch.simulate.joint_collocation import JointCollocation, name_in_recording

# What the model still predicts to gain where a fit has converged, in units of chi-square per reading, or of one where
# that is more: parameters a tenth of a standard error away, by the noise or by the residuals if they are larger.
DECREMENT = 0.01
CAP = 200  # evaluations, a guard against descents without an end
# A start is given up that is so many chi-square units behind and gains less than a quarter of its arrears in a step.
BEHIND, SHARE = 30.0, 0.25
Key = frozenset[tuple[str, str]]


@dataclass(frozen=True)
class Candidate:
    """Effects at places. starts: which of their parameters are fitted, and from where ('Q1.pump_lag.time_constant')."""

    placements: tuple[Placement, ...] = ()
    starts: tuple[Mapping[str, float], ...] = ({},)

    @property
    def key(self) -> Key:
        return frozenset((p.effect.name, p.location) for p in self.placements)


@dataclass(frozen=True)
class Fit:
    """The best fit of a candidate: parameters by name, cost (chi-square with priors) and its neighbourhood.

    converged: whether no more than DECREMENT was left to gain. One that was given up or ran out of evaluations has not.
    """

    candidate: Candidate
    space: ParameterSpace
    theta: Tensor
    cost: float
    linearised: Linearised
    converged: bool

    @property
    def values(self) -> dict[str, float]:
        return dict(zip(self.space.names, self.theta.tolist(), strict=True))

    @property
    def effect_values(self) -> dict[str, float]:
        return {n: v for n, v in self.values.items() if n.count(".") == 2}

    @property
    def key(self) -> Key:
        return self.candidate.key


@dataclass(frozen=True)
class DescentResult:
    """Where descents ended: theta (L, P), cost (L,) in chi-square units, their neighbourhoods, converged (L,) bool."""

    theta: Tensor
    cost: Tensor
    linearised: Linearised
    converged: Tensor


class Fitter:
    """Fits candidates to one subject under one noise: of the sensors, and of random flows where there are any."""

    def __init__(self, data: DataSet, noise: Noise, whitening: KalmanWhitening | None = None) -> None:
        self.data, self.noise, self.whitening = data, noise, whitening
        self.far = FAR * length_scale(data.plant)

    @property
    def log_det(self) -> float:
        """Of the variances of what `whiten` makes unit, summed over all readings."""
        if self.whitening:
            return self.whitening.log_det
        return float((2.0 * torch.log(self.noise.innovation) * self.data.mask.sum(dim=0)).sum())

    def engine(self, candidate: Candidate, free: Sequence[str]) -> Collocation | JointCollocation:
        """The plant with the candidate's effects; its space holds the nuisances and what is free."""
        network = self.network(candidate.placements)
        names = tuple(dict.fromkeys([*self.data.nuisance, *free]))
        space = ParameterSpace(network.constants[n] for n in names if "@" not in n)
        if not self.data.further:
            return Collocation(network, space, self.data.experiment)
        parts = [Collocation(network, space, part.experiment) for part in self.data.parts]
        return JointCollocation(parts, ParameterSpace(replace(space[n.partition("@")[0]], name=n) for n in names))

    def network(self, placements: Sequence[Placement]) -> TankNetwork:
        """The plant with further effects beside those it is believed to have, or in their stead."""
        known = {p.prefix for p in placements}
        nominal_effects = [p for p in self.data.nominal_effects if p.prefix not in known]
        return TankNetwork(self.data.plant, _in_library_order([*nominal_effects, *placements]))

    def fit(
        self,
        candidate: Candidate,
        base: Fit | None = None,
        target: float = math.inf,
        cap: int = CAP,
    ) -> Fit:
        """The best of the candidate's starts; nuisances and trajectory begin where `base` found them.

        target: the cost to compete with; starts that come near it too slowly are given up. cap: evaluations at most.
        """
        by_free: dict[tuple[str, ...], list[Mapping[str, float]]] = {}
        for start in candidate.starts:
            by_free.setdefault(tuple(sorted(start)), []).append(start)
        fits = [self._fit(candidate, free, starts, base, target, cap) for free, starts in by_free.items()]
        return min(fits, key=lambda f: f.cost)

    def _fit(
        self,
        candidate: Candidate,
        free: tuple[str, ...],
        starts: Sequence[Mapping[str, float]],
        base: Fit | None,
        target: float,
        cap: int,
    ) -> Fit:
        engine = self.engine(candidate, free)
        theta, levels = self._begin(engine, starts, base)
        found = self.descend(engine, theta, levels, target, cap)
        best = int(torch.nan_to_num(found.cost, nan=torch.inf).argmin())
        linearised = found.linearised.lanes(torch.tensor([best]))
        return Fit(
            candidate, engine.space, found.theta[best], float(found.cost[best]), linearised, bool(found.converged[best])
        )

    def _begin(
        self, engine: Collocation | JointCollocation, starts: Sequence[Mapping[str, float]], base: Fit | None
    ) -> tuple[Tensor, Tensor]:
        known = base.values if base else self.first_levels()
        rows = [engine.space.vector({n: v for n, v in {**known, **s}.items() if n in engine.space}) for s in starts]
        theta = torch.stack(rows)
        if base is None:
            return theta, self.first_trajectory(engine, theta)
        return theta, base.linearised.levels.expand(len(starts), -1, -1)

    def first_trajectory(self, engine: Collocation | JointCollocation, theta: Tensor) -> Tensor:
        """The model's levels (L, K+1, n) at theta (L, P), found from what the sensors show of them.

        Newton's steps from levels that stay where they start miss the trajectory where levels become equal, or meet a
        rim: its roots bend sharply there. They are the second choice, for readings that lead nowhere.
        """
        constant = engine.constant_guess(theta)
        shown = torch.cat([self._shown(part) for part in self.data.parts])
        found = engine.converge(theta, torch.where(shown.isfinite(), shown, constant))
        lost = (~(found.defect <= self.far)).nonzero().flatten()
        if not len(lost):
            return found.levels
        second = engine.converge(theta[lost], constant[lost])
        better = second.defect < found.defect[lost].nan_to_num(nan=torch.inf)
        return found.levels.index_copy(0, lost[better], second.levels[better])

    def _shown(self, part: RecordingPart) -> Tensor:
        """Levels that the sensors show at the ends of the steps (K+1, n), not a number for a tank that none sees."""
        plant, nodes = self.data.plant, part.experiment.nodes
        names = [t.name for t in plant.tanks]
        shown = nodes.new_full((len(nodes), len(names)), math.nan)
        for i, sensor in enumerate(plant.sensors):
            tank, seen = names.index(sensor.tank), part.mask[:, i]
            if bool(seen.any()):
                level = (part.readings[seen, i] - sensor.offset) / sensor.gain
                level = level.clamp(0.0, plant.tanks[tank].height)
                shown[:, tank] = interpolate(nodes, part.experiment.sample_times[seen], level)
        return shown

    def first_levels(self) -> dict[str, float]:
        """Start levels from the mean of the first few readings."""
        found = {}
        for k, part in enumerate(self.data.parts):
            for i, sensor in enumerate(self.data.plant.sensors):
                seen = part.readings[:5, i][part.mask[:5, i]]
                if len(seen):
                    level = max(float(seen.mean() - sensor.offset) / sensor.gain, 0.0)
                    found[name_in_recording(f"{sensor.tank}.start_level", k)] = level
        return found

    def descend(
        self,
        engine: Collocation | JointCollocation,
        theta: Tensor,
        levels: Tensor,
        target: float = math.inf,
        cap: int = CAP,
    ) -> DescentResult:
        """theta (L, P), levels (L, K+1, n) a guess of the trajectories there -> where least squares end."""
        problem = TrajectoryProblem(self, engine, levels)
        competition = Competition(0.5 * BEHIND, SHARE, 0.5 * target)
        # The core's cost is a negative log-likelihood, half of chi-square.
        share = DECREMENT / max(int(self.data.mask.sum()), 1)
        settings = RefineSettings(cap, 0.5 * DECREMENT, share, step_tolerance=0.0, competition=competition)
        low, high, _ = problem.box
        found = levenberg_marquardt(problem.linearise, theta, low, high, settings, neighbourhood=problem)
        assert isinstance(found.state, Linearised)
        return DescentResult(found.theta, 2.0 * found.cost, found.state, found.converged)

    def normal(
        self, space: ParameterSpace, theta: Tensor, linearised: Linearised, scale: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Cost (L,), half its gradient (L, P) and curvature (L, P, P), in scaled parameters."""
        residual, jacobian = self.white(linearised)
        pull = 1.0 / space.std(theta)
        off = (theta - space.nominal(theta)) * pull
        j, r = (jacobian * scale).permute(0, 3, 2, 1).flatten(2), residual.transpose(1, 2).flatten(1)  # time last
        cost = (r * r).sum(-1) + (off * off).sum(-1)
        gradient = (j @ r.unsqueeze(-1)).squeeze(-1) - off * pull * scale
        curvature = j @ j.mT + torch.diag_embed((pull * scale) ** 2)
        return cost, gradient, curvature

    def cost(self, fit: Fit) -> float:
        """Chi-square of a fit under this fitter's noise, with priors."""
        return float(self.normal(fit.space, fit.theta, fit.linearised, self.box(fit.space)[2])[0])

    def white(self, linearised: Linearised) -> tuple[Tensor, Tensor]:
        """Whitened residual (L, S, C) and Jacobian (L, S, C, P)."""
        residual = self.whiten(self.data.readings - linearised.readings)
        return residual, self.whiten(linearised.jacobian)

    def whiten(self, x: Tensor) -> Tensor:
        """x (*lanes, S, C) or (*lanes, S, C, P) -> the same in units of the noise, without its correlation."""
        return self.whitening(x) if self.whitening else self.noise.whiten(x, self.data.mask)

    def priors(self, space: ParameterSpace, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Scales of the parameters (P,), and their normal priors in these: roots of the precision, and how many
        standard deviations theta is off."""
        scale, std = self.box(space)[2], space.std(theta)
        return scale, (scale / std).nan_to_num(0.0), ((theta - space.nominal(theta)) / std).nan_to_num(0.0)

    def box(self, space: ParameterSpace) -> tuple[Tensor, Tensor, Tensor]:
        """Bounds, and the scale on which each parameter varies."""
        duration = max(float(part.experiment.nodes[-1]) for part in self.data.parts)
        low, high, scale = [], [], []
        for p in space:
            timed = p.unit == "s"
            top = min(p.high, duration) if timed else p.high
            low.append(p.low)
            high.append(max(top, p.nominal))
            finite = math.isfinite(p.std)
            span = top - p.low
            scale.append(p.std if finite else 0.1 * (span if math.isfinite(span) else max(abs(p.nominal), 1.0)))
        return tuple(torch.tensor(x, dtype=torch.float64) for x in (low, high, scale))  # type: ignore[return-value]


def unexplained_chi_square(fitter: Fitter, fit: Fit) -> float:
    """What a fit leaves open, chi-square units."""
    return max(low_frequency_excess(fitter.white(fit.linearised)[0][0]), 0.0)


def _in_library_order(placements: Sequence[Placement]) -> list[Placement]:
    order = {e.name: i for i, e in enumerate(EFFECTS)}
    return sorted(placements, key=lambda p: order.get(p.effect.name, len(order)))


def covariance(fitter: Fitter, fit: Fit) -> Tensor:
    """(P, P) of the fit's parameters, in their units."""
    scale = fitter.box(fit.space)[2]
    curvature = fitter.normal(fit.space, fit.theta.unsqueeze(0), fit.linearised, scale)[2][0]
    return torch.linalg.pinv(curvature, hermitian=True) * scale * scale.unsqueeze(1)


def standard_errors(fitter: Fitter, fit: Fit) -> dict[str, float]:
    """By full name."""
    variance = torch.diagonal(covariance(fitter, fit)).clamp(min=0.0)
    return dict(zip(fit.space.names, torch.sqrt(variance).tolist(), strict=True))
