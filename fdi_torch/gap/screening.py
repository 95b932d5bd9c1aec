"""What each effect would do to the readings, to first order along a trajectory, all effects and starts at once.

An effect changes the rates by w_k = f(effect) - f(without) along the fitted trajectory (`gap/forcing.py`), at the size
of a start and not by a slope at zero, so that dead zones and thresholds show too. The linearised plant turns w into
readings, and a regression beside the nuisances gives the chi-square that each could close.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.gap.fitting import Fit, Fitter
from fdi_torch.gap.forcing import Forcing
from fdi_torch.parameters import Parameter, ParameterSpace
from fdi_torch.plant.effect import Placement, Stage
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.reach import Reach
from fdi_torch.simulate.collocation import Collocation, Linearised
from fdi_torch.simulate.joint import Joint, with_blanks
from fdi_torch.simulate.scan import product, scan_in_time

Start = Mapping[str, float]


@dataclass(frozen=True)
class Option:
    """One effect at one place from one start (full names, SI)."""

    placement: Placement
    start: Start
    parameters: tuple[Parameter, ...] = ()

    @property
    def cause(self) -> tuple[str, str]:
        return self.placement.effect.name, self.placement.location


@dataclass(frozen=True)
class Screen:
    """What options would close beside a fit: with their columns C, less the nuisances' part, and what the fit leaves
    r, score (M,) = C'r and gram (M, M) = C'C; beside its diagonal not a number where pairs were not asked for."""

    options: tuple[Option, ...]
    score: Tensor
    gram: Tensor

    @property
    def size(self) -> Tensor:
        """(M,): by how much the start is to be multiplied."""
        return self.score / torch.diagonal(self.gram).clamp(min=1e-300)

    @property
    def gain(self) -> Tensor:
        """(M,): chi-square closed by each alone; 0 where only the opposite would help, or nothing is seen."""
        strength = torch.diagonal(self.gram)
        return torch.where((self.score > 0) & (strength > 1e-6), self.score**2 / strength.clamp(min=1e-300), 0.0)

    def pair_gain(self) -> Tensor:
        """(M, M): chi-square closed by two together; 0 where one of them would have to turn round."""
        g, b = torch.diagonal(self.gram), self.score
        det = g.unsqueeze(0) * g.unsqueeze(1) - self.gram**2
        first = b.unsqueeze(1) * g.unsqueeze(0) - self.gram * b.unsqueeze(0)
        fine = (det > 1e-3 * g.unsqueeze(0) * g.unsqueeze(1)) & (first > 0) & (first.T > 0)
        gain = (b.unsqueeze(1) * first + b.unsqueeze(0) * first.T) / det.clamp(min=1e-300)
        return torch.where(fine, gain, 0.0)


def options_of(placements: Sequence[Placement], fitter: Fitter, reach: Reach) -> list[Option]:
    """All starts of all placements."""
    plant = fitter.subject.plant
    return [
        Option(p, {f"{p.prefix}.{name}": value for name, value in start.items()}, parameters)
        for p in placements
        for parameters in [p.effect.parameters(p.location, plant)]
        for start in p.effect.starts(p.location, plant, reach)
    ]


def screen(fitter: Fitter, fit: Fit, options: Sequence[Option], heat: float = 1.0, pairs: bool = True) -> Screen:
    """Columns of all options about a fit, beside its own parameters. heat, pairs: as in `against`."""
    columns = effect_columns(fitter, fit, options)
    return against(fitter, fit, options, columns, heat, pairs)


def against(
    fitter: Fitter, fit: Fit, options: Sequence[Option], columns: Tensor, heat: float = 1.0, pairs: bool = True
) -> Screen:
    """Regresses whitened columns (S, C, M) beside the fit's own parameters with their priors.

    pairs: whether to say what pairs do together. heat: by which the data's chi-square is divided, as in the evidence;
    what a tolerance says is no data and stays, so that an effect which relieves a constant far out of its tolerance
    shows, however large the gap.
    """
    root = math.sqrt(heat)
    residual, jacobian = (x / root for x in fitter.white(fit.near))
    space, theta = fit.space, fit.theta
    scale = fitter.box(space)[2]
    pull = (scale / space.std(theta)).nan_to_num(0.0)
    j = torch.cat([_by_column(jacobian[0] * scale), torch.diag(pull)], dim=1)
    r = torch.cat([_by_column(residual[0].unsqueeze(-1))[0], -(theta - space.nominal(theta)) / space.std(theta)])
    # The priors' rows of the columns are zero: no constant's tolerance speaks of an effect.
    c = _by_column(columns)
    seen = c.shape[1]
    q, _ = torch.linalg.qr(torch.cat([j, 1e-6 * torch.eye(len(pull), dtype=j.dtype)], dim=1).T)
    q = q[: len(r)]
    shared, r = c @ q[:seen], r - q @ (q.T @ r)
    if pairs:
        gram = c @ c.T - shared @ shared.T
    else:
        alone = torch.linalg.vecdot(c, c) - torch.linalg.vecdot(shared, shared)
        gram = torch.full((len(c), len(c)), torch.nan, dtype=c.dtype).diagonal_scatter(alone)
    return Screen(tuple(options), c @ r[:seen] / root, gram / heat)


def _by_column(x: Tensor) -> Tensor:
    """(S, C, M) -> (M, C S): as time lies last in memory, no copy."""
    return x.permute(2, 1, 0).flatten(1)


def effect_columns(fitter: Fitter, fit: Fit, options: Sequence[Option]) -> Tensor:
    """(S, C, M): whitened changes of the readings at the size of each start."""
    own = fitter.engine(fit.candidate, list(fit.effect_values))
    pieces = own.apart(fit.theta.unsqueeze(0), fit.near) if isinstance(own, Joint) else [(own, fit.theta, fit.near)]
    columns = with_blanks([_columns(fitter, fit, options, *piece) for piece in pieces], dim=0)
    return fitter.noise.whiten(columns, fitter.subject.mask)


def _columns(
    fitter: Fitter, fit: Fit, options: Sequence[Option], own: Collocation, theta: Tensor, near: Linearised
) -> Tensor:
    """(S, C, M) of one recording."""
    experiment = own.experiment
    tried = {o.placement.prefix: o.placement for o in options}
    union = fitter.network([*(p for p in fit.candidate.placements if p.prefix not in tried), *tried.values()])
    values = zip(own.space.names, theta.flatten().tolist(), strict=True)
    known = {n: v for n, v in values if n in union.constants}
    theta = theta.reshape(1, -1)
    present = {p.prefix for p in own.network.placements} - tried.keys()
    forced = Forcing(union, present, union.bind(*_named(union, known)), near.levels[0].T.contiguous(), experiment)
    groups = _groups(options)
    moving = [i for group in groups if options[group[0]].placement.effect.stage is not Stage.READING for i in group]
    sensors, count = len(fitter.subject.plant.sensors), len(options)
    columns = theta.new_zeros(sensors, count, len(experiment.sample_times))
    forcing = theta.new_zeros(1, near.levels.shape[-1], len(moving), len(experiment.steps))
    row = {option: k for k, option in enumerate(moving)}
    for group in groups:
        placement = options[group[0]].placement
        starts = _starts([options[i] for i in group])
        if placement.effect.stage is Stage.READING:
            columns[:, group] = forced.readings(placement, starts)
        else:
            first = row[group[0]]
            forcing[0, :, first : first + len(group)] = forced.rates(placement, starts)
    if moving:
        gain, transition = near.gain.permute(0, 2, 3, 1), near.transition.permute(0, 2, 3, 1)
        still = forcing.new_zeros(1, forcing.shape[1], len(moving))
        paths = scan_in_time(transition, product(gain, forcing), still)
        columns[:, moving] = own.look(near.levels, theta).along(paths, [-1] * len(moving))[0]
    return columns.permute(2, 0, 1)


def _named(network: TankNetwork, values: Mapping[str, float]) -> tuple[ParameterSpace, Tensor]:
    space = ParameterSpace(network.constants[n] for n in values)
    return space, space.vector(values).reshape(1, 1, -1)


def _starts(options: Sequence[Option]) -> dict[str, Tensor]:
    """The parameters of options of one form by their short names, each (M, 1)."""
    return {
        name.rpartition(".")[2]: torch.tensor([[o.start[name]] for o in options], dtype=torch.float64)
        for name in options[0].start
    }


def _groups(options: Sequence[Option]) -> list[list[int]]:
    """Options that share a place, an effect and fitted parameters."""
    found: dict[tuple[str, ...], list[int]] = {}
    for i, option in enumerate(options):
        found.setdefault((option.placement.prefix, *sorted(option.start)), []).append(i)
    return list(found.values())
