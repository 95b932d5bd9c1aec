"""Candidates, sets of effects at places, and their fits."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from torch import Tensor

from fdi_torch.gap.recomputed import Recomputed
from fdi_torch.parameters import ParameterName, ParameterSpace, is_effect_parameter
from fdi_torch.plant.effect import Placement
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

    trajectory: computes the latter. converged: as that of `DescentResult`; of an explanation, under its own noise.
    """

    candidate: Candidate
    space: ParameterSpace
    theta: Tensor
    cost: float
    trajectory: Recomputed[Linearised]
    converged: bool

    @property
    def linearised(self) -> Linearised:
        return self.trajectory()

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
