"""What each effect would do to the readings, to first order along a trajectory, all effects and starts at once.

An effect changes the rates by w_k = f(effect) - f(without) along the fitted trajectory, at the size of a start and not
by a slope at zero, so that dead zones and thresholds show too. The linearised plant turns w into readings, and a
regression beside the nuisances gives the chi-square that each could close.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.gap.fitting import Candidate, Fit, Fitter
from fdi_torch.parameters import Parameter
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.reach import Reach
from fdi_torch.simulate.scan import linear_scan

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
    """What options would close beside a fit. columns (N, M): whitened, less the nuisances' part; score (M,) = C'r.

    gram (M, M) = C'C. residual (N,).
    """

    options: tuple[Option, ...]
    columns: Tensor
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
        Option(
            p,
            {f"{p.prefix}.{name}": value for name, value in start.items()},
            p.effect.parameters(p.location, plant),
        )
        for p in placements
        for start in p.effect.starts(p.location, plant, reach)
    ]


def screen(fitter: Fitter, fit: Fit, options: Sequence[Option]) -> Screen:
    """Columns of all options about a fit, beside its own parameters."""
    columns = effect_columns(fitter, fit, options)
    return against(fitter, fit, options, columns)


def against(fitter: Fitter, fit: Fit, options: Sequence[Option], columns: Tensor) -> Screen:
    """Regresses whitened columns (S, C, M) beside the fit's own parameters with their priors."""
    residual, jacobian = fitter.white(fit.near)
    space, theta = fit.space, fit.theta
    scale = fitter.box(space)[2]
    pull = (scale / space.std(theta)).nan_to_num(0.0)
    j = torch.cat([(jacobian[0] * scale).flatten(0, 1), torch.diag(pull)])
    r = torch.cat([residual[0].flatten(), -(theta - space.nominal(theta)) / space.std(theta)])
    c = torch.cat([columns.flatten(0, 1), columns.new_zeros(len(pull), columns.shape[-1])])
    q, _ = torch.linalg.qr(torch.cat([j, 1e-6 * torch.eye(len(pull), dtype=j.dtype)]))
    q = q[: len(r)]
    c, r = c - q @ (q.T @ c), r - q @ (q.T @ r)
    return Screen(tuple(options), c, c.T @ r, c.T @ c)


def effect_columns(fitter: Fitter, fit: Fit, options: Sequence[Option]) -> Tensor:
    """(S, C, M): whitened changes of the readings at the size of each start."""
    near, subject = fit.near, fitter.subject
    middle = 0.5 * (near.levels[:, 1:] + near.levels[:, :-1])
    own = fitter.engine(fit.candidate, [n for n in fit.space.names if n.count(".") == 2])
    theta = fit.theta.unsqueeze(0)
    rates, readings = own.rates(middle, theta), own.read(near.levels, theta)
    forcing = middle.new_zeros(1, *middle.shape[1:], len(options))
    direct = middle.new_zeros(1, *readings.shape[1:], len(options))
    for lanes in _groups(options):
        option = options[lanes[0]]
        candidate = Candidate((*_others(fit, option), option.placement))
        engine = fitter.engine(candidate, sorted({*_free(fit, candidate), *option.start}))
        known = {n: v for n, v in fit.values.items() if n in engine.space}
        rows = torch.stack([engine.space.vector({**known, **options[i].start}) for i in lanes])
        forcing[..., lanes] = (engine.rates(middle, rows) - rates).movedim(0, -1).unsqueeze(0)
        direct[..., lanes] = (engine.read(near.levels, rows) - readings).movedim(0, -1).unsqueeze(0)
    pushed = (near.gain.unsqueeze(-1) * forcing.unsqueeze(-3)).sum(-2)
    moving = forcing.abs().amax(dim=(0, 1, 2)) > 0
    along = linear_scan(near.transition, pushed[..., moving], forcing.new_zeros(1, middle.shape[-1], int(moving.sum())))
    if bool(moving.any()):
        direct[..., moving] += own.read_along(near.levels, along, theta)
    return fitter.noise.whiten(direct[0], subject.mask)


def _groups(options: Sequence[Option]) -> list[list[int]]:
    """Options that share a network and free parameters."""
    found: dict[tuple[str, ...], list[int]] = {}
    for i, option in enumerate(options):
        found.setdefault((option.placement.prefix, *sorted(option.start)), []).append(i)
    return list(found.values())


def _others(fit: Fit, option: Option) -> list[Placement]:
    return [p for p in fit.candidate.placements if p.prefix != option.placement.prefix]


def _free(fit: Fit, candidate: Candidate) -> list[str]:
    prefixes = {p.prefix for p in candidate.placements}
    return [n for n in fit.space.names if n.count(".") == 2 and n.rpartition(".")[0] in prefixes]
