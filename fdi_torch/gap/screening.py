"""What each effect would do to the readings, to first order along a trajectory, all effects and starts at once.

An effect changes the rates by w_k = f(effect) - f(without) along the fitted trajectory (`gap/forcing.py`), at the size
of a start and not by a slope at zero, so that dead zones and thresholds show too. The linearised plant turns w into
readings, and a regression beside the nuisances gives the chi-square that each could close.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.gap.candidate_fit import Fit, Fitter
from fdi_torch.gap.forcing import Forcing
from fdi_torch.parameters import Parameter, ParameterSpace
from fdi_torch.plant.effect import Placement, Stage
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.operating_range import OperatingRange
from fdi_torch.simulate.collocation import Collocation, Linearised
from fdi_torch.simulate.joint_collocation import JointCollocation, with_blanks
from fdi_torch.simulate.scan import scan_in_time

Start = Mapping[str, float]
AT_ONCE = 256  # options whose columns are in memory together


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
class Pairs:
    """Of each effect at each place the start that shows most, and the one that closes most: score (M,), gram (M, M) as
    in `Screen`."""

    options: tuple[Option, ...]
    score: Tensor
    gram: Tensor

    def gain(self) -> Tensor:
        """(M, M): chi-square closed by two together; 0 where one of them would have to turn round."""
        g, b = torch.diagonal(self.gram), self.score
        det = g.unsqueeze(0) * g.unsqueeze(1) - self.gram**2
        first = b.unsqueeze(1) * g.unsqueeze(0) - self.gram * b.unsqueeze(0)
        fine = (det > 1e-3 * g.unsqueeze(0) * g.unsqueeze(1)) & (first > 0) & (first.T > 0)
        gain = (b.unsqueeze(1) * first + b.unsqueeze(0) * first.T) / det.clamp(min=1e-300)
        return torch.where(fine, gain, 0.0)


@dataclass(frozen=True)
class ScreeningResult:
    """What options would close beside a fit: with their columns C, less the nuisances' part, and what the fit leaves r,
    score (M,) = C'r and strength (M,), the diagonal of C'C."""

    options: tuple[Option, ...]
    score: Tensor
    strength: Tensor
    found_pairs: Pairs | None = None

    @property
    def pairs(self) -> Pairs:
        """Raises ValueError where they were not asked for."""
        if self.found_pairs is None:
            raise ValueError("expected a screen with pairs, got one without; ask `screen` for them")
        return self.found_pairs

    @property
    def size(self) -> Tensor:
        """(M,): by how much the start is to be multiplied."""
        return self.score / self.strength.clamp(min=1e-300)

    @property
    def gain(self) -> Tensor:
        """(M,): chi-square closed by each alone; 0 where only the opposite would help, or nothing is seen."""
        strength = self.strength
        return torch.where((self.score > 0) & (strength > 1e-6), self.score**2 / strength.clamp(min=1e-300), 0.0)


def options_of(placements: Sequence[Placement], fitter: Fitter, reach: OperatingRange) -> list[Option]:
    """All starts of all placements."""
    plant = fitter.data.plant
    return [
        Option(p, {f"{p.prefix}.{name}": value for name, value in start.items()}, parameters)
        for p in placements
        for parameters in [p.effect.parameters(p.location, plant)]
        for start in p.effect.starts(p.location, plant, reach)
    ]


def screen(fitter: Fitter, fit: Fit, options: Sequence[Option], pairs: bool = True) -> ScreeningResult:
    """All options about a fit, beside its own parameters with their priors. pairs: whether to say what pairs do."""
    beside = _ProjectedRegression.of(fitter, fit)
    found = [beside.screened(options[k : k + AT_ONCE]) for k in range(0, len(options), AT_ONCE)]
    score, strength = (torch.cat([f[k] for f in found]) if found else torch.zeros(0).double() for k in range(2))
    whole = ScreeningResult(tuple(options), score, strength)
    return replace(whole, found_pairs=beside.pairs(whole)) if pairs else whole


@dataclass(frozen=True)
class _ProjectedRegression:
    """A regression beside the parameters of a fit. left (S, C): its whitened residual without what they can do; basis
    (S, C, P) of that."""

    fitter: Fitter
    fit: Fit
    left: Tensor
    basis: Tensor

    @staticmethod
    def of(fitter: Fitter, fit: Fit) -> _ProjectedRegression:
        residual, jacobian = (x[0] for x in fitter.white(fit.linearised))
        scale, pull, off = fitter.priors(fit.space, fit.theta)
        # The priors' rows of the columns are zero: no constant's tolerance speaks of an effect.
        rows = torch.diag(pull), 1e-6 * torch.eye(len(pull), dtype=pull.dtype)
        q, _ = torch.linalg.qr(torch.cat([(jacobian * scale).flatten(0, 1), *rows]))
        r = torch.cat([residual.flatten(), -off, torch.zeros_like(off)])
        seen = residual.numel()
        left = (r - q @ (q.T @ r))[:seen]
        return _ProjectedRegression(fitter, fit, left.reshape(residual.shape), q[:seen].reshape(*residual.shape, -1))

    def screened(self, options: Sequence[Option]) -> tuple[Tensor, Tensor]:
        """Score and strength, (M,) each."""
        columns = effect_columns(self.fitter, self.fit, options)
        score, strength = columns.new_zeros(2, len(options)).unbind()
        shared = columns.new_zeros(len(options), self.basis.shape[-1])
        for c in range(columns.shape[1]):
            own = columns[:, c].T
            score += own @ self.left[:, c]
            strength += torch.linalg.vecdot(own, own)
            shared += own @ self.basis[:, c]
        return score, strength - torch.linalg.vecdot(shared, shared)

    def pairs(self, found: ScreeningResult) -> Pairs:
        chosen: set[int] = set()
        for value in (found.strength, found.gain):
            best: dict[tuple[str, str], int] = {}
            for i in torch.argsort(value, descending=True).tolist():
                best.setdefault(found.options[i].cause, i)
            chosen |= set(best.values())
        kept = sorted(chosen)
        options = tuple(found.options[i] for i in kept)
        columns = effect_columns(self.fitter, self.fit, options).permute(1, 0, 2)
        shared = (columns.mT @ self.basis.permute(1, 0, 2)).sum(dim=0)
        gram = (columns.mT @ columns).sum(dim=0) - shared @ shared.T
        return Pairs(options, found.score[kept], gram)


def effect_columns(fitter: Fitter, fit: Fit, options: Sequence[Option]) -> Tensor:
    """(S, C, M): whitened changes of the readings at the size of each start."""
    own = fitter.engine(fit.candidate, list(fit.effect_values))
    pieces = (
        own.apart(fit.theta.unsqueeze(0), fit.linearised)
        if isinstance(own, JointCollocation)
        else [(own, fit.theta, fit.linearised)]
    )
    columns = with_blanks([_columns(fitter, fit, options, *piece) for piece in pieces], dim=0)
    return fitter.whiten(columns)


def _columns(
    fitter: Fitter, fit: Fit, options: Sequence[Option], own: Collocation, theta: Tensor, linearised: Linearised
) -> Tensor:
    """(S, C, M) of one recording."""
    experiment = own.experiment
    tried = {o.placement.prefix: o.placement for o in options}
    union = fitter.network([*(p for p in fit.candidate.placements if p.prefix not in tried), *tried.values()])
    values = zip(own.space.names, theta.flatten().tolist(), strict=True)
    known = {n: v for n, v in values if n in union.constants}
    theta = theta.reshape(1, -1)
    present = {p.prefix for p in own.network.placements} - tried.keys()
    forced = Forcing(union, present, union.bind(*_named(union, known)), linearised.levels[0].T.contiguous(), experiment)
    groups = _groups(options)
    moving = [i for group in groups if options[group[0]].placement.effect.stage is not Stage.READING for i in group]
    sensors, count = len(fitter.data.plant.sensors), len(options)
    columns = theta.new_zeros(sensors, count, len(experiment.sample_times))
    forcing = theta.new_zeros(1, linearised.levels.shape[-1], len(moving), len(experiment.steps))
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
        gain, transition = linearised.gain.permute(0, 2, 3, 1), linearised.transition.permute(0, 2, 3, 1)
        still = forcing.new_zeros(1, forcing.shape[1], len(moving))
        paths = scan_in_time(transition, forcing, still, gain)
        columns[:, moving] = own.look(linearised.levels, theta).along(paths, [-1] * len(moving))[0]
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
