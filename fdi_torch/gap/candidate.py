"""Candidates, sets of effects at places, and their fits."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from torch import Tensor

from fdi_torch.gap.recomputed import Recomputed
from fdi_torch.parameters import ParameterName, ParameterSpace, is_effect_parameter
from fdi_torch.plant.effect import Placement
from fdi_torch.simulate.collocation import Collocation
from fdi_torch.simulate.joint_collocation import JointCollocation
from fdi_torch.simulate.linearised import Linearised

Key = frozenset[tuple[str, str]]


@dataclass(frozen=True)
class Candidate:
    """Effects at places. starts: the fitted parameters of these effects with initial values
    ('Q1.pump_lag.time_constant')."""

    placements: tuple[Placement, ...] = ()
    starts: tuple[Mapping[str, float], ...] = ({},)

    @property
    def key(self) -> Key:
        return frozenset(p.cause for p in self.placements)


@dataclass(frozen=True, eq=False)
class Fit:
    """The best fit of a candidate: parameters theta (P,), cost (chi-square with priors), linearised trajectory.

    engine: the plant with the effects, differentiated by all parameters. trajectory: computes the latter. converged: as
    that of `DescentResult`; of an explanation, under its own noise.
    """

    candidate: Candidate
    engine: Collocation | JointCollocation
    theta: Tensor
    cost: float
    trajectory: Recomputed[Linearised]
    converged: bool

    @property
    def space(self) -> ParameterSpace:
        return self.engine.space

    @property
    def linearised(self) -> Linearised:
        return self.trajectory()

    def pieces(self, linearised: Linearised) -> list[tuple[Collocation, Tensor, Linearised]]:
        """For each recording, its collocation, its parameters (1, P) and its part of a trajectory."""
        return self.engine.apart(self.theta.unsqueeze(0), linearised)

    @property
    def values(self) -> dict[str, float]:
        return dict(zip(self.space.names, self.theta.tolist(), strict=True))

    @property
    def effect_values(self) -> dict[str, float]:
        return {n: v for n, v in self.values.items() if is_effect_parameter(n)}

    def values_of(self, placements: Iterable[Placement]) -> dict[str, float]:
        """The fitted parameters of some of the effects, by full name."""
        prefixes = {p.prefix for p in placements}
        return {n: v for n, v in self.values.items() if ParameterName.parse(n).prefix in prefixes}

    @property
    def key(self) -> Key:
        return self.candidate.key
