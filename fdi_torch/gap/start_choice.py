"""Choice among the initial values of further effects, by separable least squares about a fit without them.

Only the parameters z of the effects that the fit lacks vary; all others follow linearly, with the sensitivities J and
the parameters x of the fit:

    chi^2(z) = min over dx of |W (y - y(x, z) - J dx)|^2 + |x + dx - nominal|^2 / tolerance^2

which is the variable projection of Golub and Pereyra (1973) with constant J. A descent costs as many sensitivities as z
has entries, instead of 6 more at three tanks and 26 more at eleven. The full problem is then solved from the best end.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from fdi_torch.estimate.linear_parameters import decomposed
from fdi_torch.gap.candidate import Fit
from fdi_torch.gap.trajectory_problem import Objective, TrajectoryProblem, descend, first_lowest
from fdi_torch.parameters import ParameterSpace
from fdi_torch.simulate.collocation import Collocation
from fdi_torch.simulate.joint_collocation import JointCollocation
from fdi_torch.simulate.linearised import Linearised

NEAR = 1.0  # chi-square units; starts are compared when less than this remained to gain
SHARES = (1.0, 0.5, 0.25, 0.0)  # of the change of the linear parameters, which is taken as far as it lowers chi-square


@dataclass(frozen=True)
class Start:
    """free: names of the effects' parameters that are fitted. values: of these, and of any others."""

    free: tuple[str, ...]
    values: Mapping[str, float]


def vector_of(space: ParameterSpace, values: Mapping[str, float]) -> Tensor:
    """Values (P,) of a space; nominal ones for parameters that have none."""
    return space.vector({n: v for n, v in values.items() if n in space})


def likeliest_starts(
    objective: Objective,
    base: Fit,
    engine: Collocation | JointCollocation,
    starts: Sequence[Start],
    target: float,
) -> list[Start]:
    """The best end point of the reduced descents from all starts that share their other parameters with `base`, and the
    other starts as they are.

    base: fit of some of the effects. engine: of the union of the starts' parameters; differentiates by those that
    `base` lacks. target: cost of the competitor.
    """
    about, others = list[Start](), list[Start]()
    for start in starts:
        as_in_base = all(base.values[n] == v for n, v in start.values.items() if n in base.space)
        (about if as_in_base else others).append(start)
    if len(about) < 2:
        return list(starts)
    shared = [n for n in engine.space.names if n in base.space]
    of_shared, in_base = (torch.tensor([s.index(n) for n in shared]) for s in (engine.space, base.space))
    varied = torch.tensor([engine.space.index(n) for n in engine.by])
    theta = torch.stack([vector_of(engine.space, {**base.values, **s.values}) for s in about])
    projected = _projected(objective, base, tuple(in_base.tolist()))
    reduced = _Varied(engine, theta[0], varied)
    low, high, scale = objective.box(engine.space)
    # A start that lacks a parameter of others has it at its nominal value.
    fixed = torch.tensor([[n not in s.free for n in engine.by] for s in about])
    own = theta[:, varied]
    box = torch.where(fixed, own, low[varied]), torch.where(fixed, own, high[varied])
    end = descend(TrajectoryProblem(projected, reduced), own, len(projected.basis), target, decrement=NEAR, box=box)
    best = first_lowest(end.cost)
    change = projected.change(objective.residual(end.linearised.readings[best : best + 1])) * scale[of_shared]
    shares = torch.tensor(SHARES, dtype=theta.dtype)
    tried = theta[best].repeat(len(SHARES), 1)
    tried[:, varied] = end.theta[best]
    tried[:, of_shared] += shares.unsqueeze(1) * change
    tried = torch.minimum(torch.maximum(tried, low), high)
    readings = engine.read(engine.trajectories(tried), tried)
    cost = objective.chi_square(engine.space, tried, objective.residual(readings))
    likeliest = first_lowest(cost)
    values = dict(zip(engine.space.names, tried[likeliest].tolist(), strict=True))
    return [Start(about[best].free, values), *others]


@dataclass(frozen=True)
class _Projected:
    """Chi-square minimised over linear parameters. basis (S C, P), factor (P, P): of the QR decomposition of their
    whitened sensitivities, the rows of Q that belong to the readings, and R. pull (P,), off: Q'r and r'r over the rows
    of the priors, with their residuals r."""

    objective: Objective
    basis: Tensor
    factor: Tensor
    pull: Tensor
    off: float

    @staticmethod
    def of(objective: Objective, base: Fit, which: Tensor) -> _Projected:
        """which (P,): the linear parameters among those of `base`."""
        scale, weight, deviation = (x[which] for x in objective.priors(base.space, base.theta))
        jacobian = objective.whiten(base.linearised.jacobian[..., which])[0] * scale
        basis, factor = decomposed(jacobian.flatten(0, 1), weight)
        rows = len(basis) - len(which)
        pull = -(deviation @ basis[rows:])
        return _Projected(objective, basis[:rows], factor, pull, float(deviation.square().sum()))

    def box(self, space: ParameterSpace) -> tuple[Tensor, Tensor, Tensor]:
        return self.objective.box(space)

    def priors(self, space: ParameterSpace, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return self.objective.priors(space, theta)

    def residual(self, readings: Tensor) -> Tensor:
        return self.objective.residual(readings)

    def white(self, linearised: Linearised) -> tuple[Tensor, Tensor]:
        return self.objective.white(linearised)

    def whiten(self, x: Tensor) -> Tensor:
        """Whitened columns (L, S, C) without what the linear parameters explain."""
        white = self.objective.whiten(x)
        along = self._along(white.unsqueeze(-1))
        return white - (self.basis @ along).reshape(white.shape)

    def chi_square(self, space: ParameterSpace, theta: Tensor, residual: Tensor) -> Tensor:
        along = self._along(residual.unsqueeze(-1)).squeeze(-1) + self.pull
        return self.objective.chi_square(space, theta, residual) + self.off - along.square().sum(-1)

    def normal(
        self, space: ParameterSpace, theta: Tensor, residual: Tensor, jacobian: Tensor, scale: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        cost, descent, curvature = self.objective.normal(space, theta, residual, jacobian, scale)
        along = self._along(residual.unsqueeze(-1)) + self.pull.unsqueeze(-1)
        of_columns = self._along(jacobian * scale)
        return (
            cost + self.off - along.square().sum((-1, -2)),
            descent - (of_columns.mT @ along).squeeze(-1),
            curvature - of_columns.mT @ of_columns,
        )

    def change(self, residual: Tensor) -> Tensor:
        """The linear parameters' most likely change (P,), in their scales, given a whitened residual (1, S, C)."""
        along = self._along(residual.unsqueeze(-1))[0] + self.pull.unsqueeze(-1)
        return torch.linalg.solve_triangular(self.factor, along, upper=True).squeeze(-1)

    def _along(self, columns: Tensor) -> Tensor:
        """Products (L, P, M) of the basis with whitened columns (L, S, C, M); each lane apart, so that it gives the
        same alone and in a batch."""
        return torch.stack([self.basis.T @ lane.flatten(0, 1) for lane in columns])


@lru_cache(maxsize=1)  # all candidates that extend one fit share it
def _projected(objective: Objective, base: Fit, which: tuple[int, ...]) -> _Projected:
    return _Projected.of(objective, base, torch.tensor(which))


class _Varied:
    """An engine of which only some parameters vary. theta (P,): all; varied (V,): indices of those."""

    def __init__(self, engine: Collocation | JointCollocation, theta: Tensor, varied: Tensor) -> None:
        self.engine, self.theta, self.varied = engine, theta, varied
        self.space = ParameterSpace(engine.space[n] for n in engine.by)

    def linearise(self, theta: Tensor, levels: Tensor) -> Linearised:
        return self.engine.linearise(self._full(theta), levels)

    def trajectories(self, theta: Tensor, guess: Tensor | None = None) -> Tensor:
        return self.engine.trajectories(self._full(theta), guess)

    def read(self, levels: Tensor, theta: Tensor) -> Tensor:
        return self.engine.read(levels, self._full(theta))

    def _full(self, theta: Tensor) -> Tensor:
        return self.theta.repeat(len(theta), 1).index_copy(1, self.varied, theta)
