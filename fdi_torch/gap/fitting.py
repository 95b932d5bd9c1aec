"""Fits of one model, from many starts at once, to one recording: Levenberg-Marquardt on whole trajectories."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.effects import EFFECTS
from fdi_torch.gap.floor import Noise, slow_excess
from fdi_torch.gap.subject import Subject
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.pace import length_scale
from fdi_torch.simulate.collocation import Collocation, Linearised
from fdi_torch.simulate.joint import Joint, own_name

ROUNDS = 14
SETTLED = 0.05  # chi-square units; smaller gains decide nothing
PATIENCE, ENOUGH = 1, 4.0  # a start is given up that gains less than a quarter of its arrears after two rounds
CORRECTIONS = 6  # of a trajectory that a step of the parameters moved
FAR = 1e-3  # in units of the plant's length scale: a defect from which a correction is worth its cost
LONG, NEARLY = 4.0, 10.0  # in the same: a shift that needs a correction, and a defect that one more makes good
LOST, STALLED = 100.0, 0.9  # a trajectory so many times too far off that a correction brings no nearer has no end
Key = frozenset[tuple[str, str]]


@dataclass(frozen=True)
class Candidate:
    """Effects at places. starts: which of their parameters are fitted, and from where ('Q1.pump_lag.time_constant').

    promise: chi-square that the newest of them closes to first order.
    """

    placements: tuple[Placement, ...] = ()
    starts: tuple[Mapping[str, float], ...] = ({},)
    promise: float = 0.0

    @property
    def key(self) -> Key:
        return frozenset((p.effect.name, p.location) for p in self.placements)


@dataclass(frozen=True)
class Fit:
    """The best fit of a candidate: parameters by name, cost (chi-square with priors) and its neighbourhood."""

    candidate: Candidate
    space: ParameterSpace
    theta: Tensor
    cost: float
    near: Linearised

    @property
    def values(self) -> dict[str, float]:
        return dict(zip(self.space.names, self.theta.tolist(), strict=True))

    @property
    def effect_values(self) -> dict[str, float]:
        return {n: v for n, v in self.values.items() if n.count(".") == 2}

    @property
    def key(self) -> Key:
        return self.candidate.key


class Fitter:
    """Fits candidates to one subject under one noise."""

    def __init__(self, subject: Subject, noise: Noise) -> None:
        self.subject, self.noise = subject, noise
        self.far = FAR * length_scale(subject.plant)

    def engine(self, candidate: Candidate, free: Sequence[str]) -> Collocation | Joint:
        """The plant with the candidate's effects; its space holds the nuisances and what is free."""
        network = self.network(candidate.placements)
        names = tuple(dict.fromkeys([*self.subject.nuisance, *free]))
        space = ParameterSpace(network.constants[n] for n in names if "@" not in n)
        if not self.subject.further:
            return Collocation(network, space, self.subject.experiment)
        parts = [Collocation(network, space, part.experiment) for part in self.subject.parts]
        return Joint(parts, ParameterSpace(replace(space[n.partition("@")[0]], name=n) for n in names))

    def network(self, placements: Sequence[Placement]) -> TankNetwork:
        """The plant with further effects beside those it is believed to have, or in their stead."""
        known = {p.prefix for p in placements}
        believed = [p for p in self.subject.believed if p.prefix not in known]
        return TankNetwork(self.subject.plant, _in_library_order([*believed, *placements]))

    def fit(
        self,
        candidate: Candidate,
        base: Fit | None = None,
        rounds: int = ROUNDS,
        target: float = -math.inf,
        settled: float = SETTLED,
    ) -> Fit:
        """The best of the candidate's starts; nuisances and trajectory begin where `base` found them.

        target: the cost to compete with; starts that come near it too slowly are given up. settled: chi-square units;
        a start that gains less in a round is there.
        """
        by_free: dict[tuple[str, ...], list[Mapping[str, float]]] = {}
        for start in candidate.starts:
            by_free.setdefault(tuple(sorted(start)), []).append(start)
        fits = [self._fit(candidate, free, starts, base, rounds, target, settled) for free, starts in by_free.items()]
        return min(fits, key=lambda f: f.cost)

    def _fit(
        self,
        candidate: Candidate,
        free: tuple[str, ...],
        starts: Sequence[Mapping[str, float]],
        base: Fit | None,
        rounds: int,
        target: float,
        settled: float,
    ) -> Fit:
        engine = self.engine(candidate, free)
        theta, levels = self._begin(engine, starts, base)
        theta, cost, near = self.descend(engine, theta, levels, rounds, target, settled)
        best = int(torch.nan_to_num(cost, nan=torch.inf).argmin())
        return Fit(candidate, engine.space, theta[best], float(cost[best]), near.lanes(torch.tensor([best])))

    def _begin(
        self, engine: Collocation | Joint, starts: Sequence[Mapping[str, float]], base: Fit | None
    ) -> tuple[Tensor, Tensor]:
        known = base.values if base else self.first_levels()
        rows = [engine.space.vector({n: v for n, v in {**known, **s}.items() if n in engine.space}) for s in starts]
        theta = torch.stack(rows)
        if base is None:
            guess = engine.constant_guess(theta)
            return theta, engine.settle(theta, guess).levels
        return theta, base.near.levels.expand(len(starts), -1, -1)

    def first_levels(self) -> dict[str, float]:
        """Start levels from the mean of the first few readings."""
        found = {}
        for k, part in enumerate(self.subject.parts):
            for i, sensor in enumerate(self.subject.plant.sensors):
                seen = part.readings[:5, i][part.mask[:5, i]]
                if len(seen):
                    level = max(float(seen.mean() - sensor.offset) / sensor.gain, 0.0)
                    found[own_name(f"{sensor.tank}.start_level", k)] = level
        return found

    def descend(
        self,
        engine: Collocation | Joint,
        theta: Tensor,
        levels: Tensor,
        rounds: int,
        target: float = -math.inf,
        settled: float = SETTLED,
    ) -> tuple[Tensor, Tensor, Linearised]:
        """theta (L, P), levels (L, K+1, n) -> where Levenberg-Marquardt ends, its cost (L,) and neighbourhood."""
        low, high, scale = self.box(engine.space)
        near = _settled(engine, theta, engine.linearise(theta, levels), self.far)
        cost, gradient, curvature = self.normal(engine.space, theta, near, scale)
        damping = torch.full_like(cost, 1e-3)
        active = torch.isfinite(cost)
        for turn in range(rounds):
            lanes = active.nonzero().flatten()
            if not len(lanes):
                break
            step = _bounded_step(gradient[lanes], curvature[lanes], damping[lanes], theta[lanes], low, high, scale)
            moved = torch.minimum(torch.maximum(theta[lanes] + step, low), high)
            moves = (moved - theta[lanes]).unsqueeze(1).unsqueeze(1)
            shift = (near.slopes[lanes] * moves).sum(-1)
            tried = _followed(engine, moved, near.levels[lanes] + shift, shift, self.far)
            new_cost, new_gradient, new_curvature = self.normal(engine.space, moved, tried, scale)
            # What a trajectory leaves that is not the model's, for it was not followed to its end, says nothing.
            better = (new_cost < cost[lanes]) & (tried.defect <= near.defect[lanes].clamp(min=self.far))
            gain = torch.where(better, cost[lanes] - new_cost, torch.zeros_like(new_cost))
            take = lanes[better]
            theta, cost = theta.index_copy(0, take, moved[better]), cost.index_copy(0, take, new_cost[better])
            gradient = gradient.index_copy(0, take, new_gradient[better])
            curvature = curvature.index_copy(0, take, new_curvature[better])
            near = _replaced(near, take, tried.lanes(better))
            damping[lanes] = torch.where(better, damping[lanes] * 0.2, damping[lanes] * 10.0).clamp(1e-9, 1e8)
            rival = float(cost.min()) if len(cost) > 1 and not math.isfinite(target) else target
            behind = cost[lanes] - rival if math.isfinite(rival) else torch.zeros_like(gain)
            hopeless = (turn >= PATIENCE) & (ENOUGH * gain < behind) & (behind > 30.0)
            done = (better & (gain < settled)) | (damping[lanes] > 1e4) | hopeless
            active[lanes[done]] = False
        return theta, cost, near

    def normal(
        self, space: ParameterSpace, theta: Tensor, near: Linearised, scale: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Cost (L,), half its gradient (L, P) and curvature (L, P, P), in scaled parameters."""
        residual, jacobian = self.white(near)
        pull = 1.0 / space.std(theta)
        off = (theta - space.nominal(theta)) * pull
        j, r = (jacobian * scale).permute(0, 3, 2, 1).flatten(2), residual.transpose(1, 2).flatten(1)  # time last
        cost = (r * r).sum(-1) + (off * off).sum(-1)
        gradient = (j @ r.unsqueeze(-1)).squeeze(-1) - off * pull * scale
        curvature = j @ j.mT + torch.diag_embed((pull * scale) ** 2)
        return cost, gradient, curvature

    def white(self, near: Linearised) -> tuple[Tensor, Tensor]:
        """Whitened residual (L, S, C) and Jacobian (L, S, C, P)."""
        subject = self.subject
        residual = self.noise.whiten(subject.readings - near.readings, subject.mask)
        return residual, self.noise.whiten(near.jacobian, subject.mask)

    def box(self, space: ParameterSpace) -> tuple[Tensor, Tensor, Tensor]:
        """Bounds, and the scale on which each parameter varies."""
        duration = max(float(part.experiment.nodes[-1]) for part in self.subject.parts)
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


def left_open(fitter: Fitter, fit: Fit) -> float:
    """What a fit leaves open, chi-square units."""
    return max(slow_excess(fitter.white(fit.near)[0][0]), 0.0)


def _followed(engine: Collocation | Joint, theta: Tensor, guess: Tensor, shift: Tensor, far: float) -> Linearised:
    """The neighbourhood of trajectories that are guessed to be `shift` from known ones; slopes are worked out once a
    guess is good.
    """
    levels, lost = guess, torch.zeros(len(theta), dtype=torch.bool)
    lanes = (shift.abs().amax(dim=(-1, -2)) > LONG * far).nonzero().flatten()
    defect = torch.full((len(theta),), torch.inf, dtype=guess.dtype)
    for _ in range(CORRECTIONS - 1):
        if not len(lanes):
            break
        before = defect[lanes]
        path, moved = engine.corrected(theta[lanes], levels[lanes])
        levels, defect = levels.index_copy(0, lanes, path), defect.index_copy(0, lanes, moved)
        lost[lanes] = _no_nearer(moved, before, far)
        lanes = lanes[(moved > NEARLY * far) & ~lost[lanes]]
    return _settled(engine, theta, engine.linearise(theta, levels), far, lost)


def _settled(
    engine: Collocation | Joint, theta: Tensor, near: Linearised, far: float, lost: Tensor | None = None
) -> Linearised:
    """The lanes whose trajectories were still far from the model's corrected until they are not, or no more."""
    lost = torch.zeros_like(near.defect, dtype=torch.bool) if lost is None else lost
    for _ in range(CORRECTIONS):
        lanes = (~lost & (near.defect > far)).nonzero().flatten()
        if not len(lanes):
            break
        before = near.defect
        near = _replaced(near, lanes, engine.linearise(theta[lanes], near.levels[lanes]))
        lost = lost | _no_nearer(near.defect, before, far)
    return near


def _no_nearer(defect: Tensor, before: Tensor, far: float) -> Tensor:
    """Which lanes (L,) a correction has not brought nearer to a trajectory that they are lost from."""
    return ~((defect < LOST * far) | (defect < STALLED * before))


def _bounded_step(
    gradient: Tensor, curvature: Tensor, damping: Tensor, theta: Tensor, low: Tensor, high: Tensor, scale: Tensor
) -> Tensor:
    """The damped step; parameters that a bound stops are left out of it, once more after a first look."""
    stuck = ((theta <= low) & (gradient < 0)) | ((theta >= high) & (gradient > 0))
    for _ in range(2):
        free = (~stuck).to(theta.dtype)
        h = curvature * free.unsqueeze(-1) * free.unsqueeze(-2)
        diagonal = torch.diagonal(h, dim1=-2, dim2=-1)
        added = damping.unsqueeze(-1) * diagonal + (1.0 - free) + 1e-9 * diagonal.amax(-1, keepdim=True) + 1e-12
        step = torch.linalg.solve(h + torch.diag_embed(added), (gradient * free).unsqueeze(-1)).squeeze(-1) * scale
        step = torch.nan_to_num(step, nan=0.0, posinf=0.0, neginf=0.0)
        # A bound that is overshot from where the parameter already lies on it holds the parameter there.
        stuck = stuck | ((theta + step <= low) & (theta <= low)) | ((theta + step >= high) & (theta >= high))
    return step


def _replaced(near: Linearised, lanes: Tensor, new: Linearised) -> Linearised:
    if len(lanes) == len(near.defect):
        return new
    fields = {name: getattr(near, name).index_copy(0, lanes, getattr(new, name)) for name in near.__dataclass_fields__}
    return replace(near, **fields)


def _in_library_order(placements: Sequence[Placement]) -> list[Placement]:
    order = {e.name: i for i, e in enumerate(EFFECTS)}
    return sorted(placements, key=lambda p: order.get(p.effect.name, len(order)))
