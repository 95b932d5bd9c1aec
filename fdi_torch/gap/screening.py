"""First-order screening of effects: by how much each effect of the library, added to a fit, would reduce the fit's
chi-square if the plant were linear about the fitted trajectory.

An effect changes the level rates by w_k = f(with effect) - f(without) along the fitted trajectory (`forcing.py`). The
size of the effect is that of a start, not a slope at zero, so that dead zones and thresholds are visible. The
linearised plant maps w to readings, and a regression with the nuisance parameters projected out gives the gain of each
effect.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.estimate.linear_parameters import decomposed, without
from fdi_torch.gap.candidate import Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.forcing import Forcing
from fdi_torch.parameters import Parameter, ParameterName, ParameterSpace
from fdi_torch.plant.effect import Placement, Stage
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.operating_range import OperatingRange
from fdi_torch.simulate.collocation import Collocation
from fdi_torch.simulate.joint_collocation import with_blanks
from fdi_torch.simulate.linearised import Linearised
from fdi_torch.simulate.scan import scan_in_time

Start = Mapping[str, float]
BATCH = 64  # options whose columns are in memory together


@dataclass(frozen=True)
class Option:
    """One effect at one place with one start (full names, SI)."""

    placement: Placement
    start: Start
    parameters: tuple[Parameter, ...] = ()

    @property
    def cause(self) -> tuple[str, str]:
        return self.placement.cause

    @property
    def instants(self) -> list[str]:
        """Full names of the start's times, if it is one of a grid of onsets, or of intervals."""
        names = [self.placement.full_name(name) for name in self.placement.effect.instants]
        return names if all(name in self.start for name in names) else []

    @property
    def late(self) -> bool:
        """Whether it acts from an onset on instead of from the beginning of the recording."""
        return len(self.instants) == 1


@dataclass(frozen=True)
class Pairs:
    """Regression on pairs of effects: of each effect at each place, the most visible start and the one with the largest
    gain.

    score (M,), gram (M, M) as in `ScreeningResult`.
    """

    options: tuple[Option, ...]
    score: Tensor
    gram: Tensor

    def gain(self) -> Tensor:
        """Reduction of chi-square by two options together (M, M); 0 if one of them had to have a negative size."""
        g, b = torch.diagonal(self.gram), self.score
        det = g.unsqueeze(0) * g.unsqueeze(1) - self.gram**2
        first = b.unsqueeze(1) * g.unsqueeze(0) - self.gram * b.unsqueeze(0)
        valid = (det > 1e-3 * g.unsqueeze(0) * g.unsqueeze(1)) & (first > 0) & (first.T > 0)
        gain = (b.unsqueeze(1) * first + b.unsqueeze(0) * first.T) / det.clamp(min=1e-300)
        return torch.where(valid, gain, 0.0)


@dataclass(frozen=True)
class ScreeningResult:
    """Regression of a residual r on the column C of each option, with the nuisance parameters projected out.

    score (M,) = C'r; strength (M,) = diagonal of C'C.
    """

    options: tuple[Option, ...]
    score: Tensor
    strength: Tensor

    def __add__(self, other: ScreeningResult) -> ScreeningResult:
        """The options of both, which were screened with the same noise model."""
        score, strength = (torch.cat([getattr(x, name) for x in (self, other)]) for name in ("score", "strength"))
        return ScreeningResult(self.options + other.options, score, strength)

    def promising(self, count: int) -> list[Option]:
        """All options of the `count` effects with the largest gain."""
        best = dict.fromkeys(self.options[i].cause for i in torch.argsort(self.gain, descending=True).tolist())
        causes = list(best)[:count]
        return [o for o in self.options if o.cause in causes]

    @property
    def size(self) -> Tensor:
        """The factor (M,) by which each option's start values are multiplied for the best linear fit."""
        return self.score / self.strength.clamp(min=1e-300)

    @property
    def gain(self) -> Tensor:
        """Reduction of chi-square by each option alone (M,); 0 if its size had to be negative or nothing is visible."""
        strength = self.strength
        return torch.where((self.score > 0) & (strength > 1e-6), self.score**2 / strength.clamp(min=1e-300), 0.0)


def most_visible(options: Sequence[Option], strength: Tensor) -> dict[tuple[str, str], int]:
    """The most visible start of each cause, among those that act from the beginning if there are any.

    Onsets make causes separable that are not if they act from the beginning.
    """
    best: dict[tuple[str, str], int] = {}
    for i in sorted(range(len(options)), key=lambda i: (not options[i].late, float(strength[i])), reverse=True):
        best.setdefault(options[i].cause, i)
    return best


def options_of(placements: Sequence[Placement], fitter: Fitter, operating_range: OperatingRange) -> list[Option]:
    """One option for each start value of each effect at each place."""
    plant = fitter.data.plant
    return [
        Option(p, {p.full_name(name): value for name, value in start.items()}, parameters)
        for p in placements
        for parameters in [p.effect.parameters(p.location, plant)]
        for start in p.effect.starts(p.location, plant, operating_range)
    ]


def screen(fitter: Fitter, fit: Fit, options: Sequence[Option]) -> ScreeningResult:
    """Screen all options about a fit."""
    return screen_under_each([fitter], fit, options)[0]


def screen_under_each(fitters: Sequence[Fitter], fit: Fit, options: Sequence[Option]) -> list[ScreeningResult]:
    """Screen all options about a fit under the noise of each fitter."""
    regressions = [_ProjectedRegression.of(fitter, fit) for fitter in fitters]
    sums = torch.zeros(len(fitters), 2, len(options), dtype=fit.theta.dtype)
    influence = _EffectColumns(fitters[0], fit, options)
    for k in range(0, len(options), BATCH):
        columns = influence.of(options[k : k + BATCH])
        for regression, of_all in zip(regressions, sums, strict=True):
            of_all[:, k : k + BATCH] = torch.stack(regression.screened(columns))
    return [ScreeningResult(tuple(options), score, strength) for score, strength in sums]


def products(fitter: Fitter, fit: Fit, options: Sequence[Option], besides: Sequence[str] = ()) -> tuple[Tensor, Tensor]:
    """Score (M,) and gram (M, M) of options in addition to a fit, as in `ScreeningResult` and `Pairs`.

    besides: parameters of the fit that are not projected out.
    """
    return products_of(fitter, fit, effect_columns(fitter, fit, options), besides)


def products_of(fitter: Fitter, fit: Fit, columns: Tensor, besides: Sequence[str] = ()) -> tuple[Tensor, Tensor]:
    """Score (M,) and gram (M, M) of changes of the readings (S, C, M), as in `products`."""
    white, shared, score = _ProjectedRegression.of(fitter, fit, besides).projected(columns)
    return score, (white @ white.mT).sum(dim=0) - shared @ shared.T


def pairs_of(fitter: Fitter, fit: Fit, screening: ScreeningResult) -> Pairs:
    """The regression on pairs of the most promising options of a screening under the same noise."""
    chosen = set(most_visible(screening.options, screening.strength).values())
    best: dict[tuple[str, str], int] = {}
    for i in torch.argsort(screening.gain, descending=True).tolist():
        best.setdefault(screening.options[i].cause, i)
    chosen |= set(best.values())
    options = tuple(screening.options[i] for i in sorted(chosen))
    return Pairs(options, *products(fitter, fit, options))


@dataclass(frozen=True)
class _ProjectedRegression:
    """A regression with the parameters of a fit projected out.

    remaining (S, C): whitened residual after the projection. basis (S, C, P): orthonormal basis of the parameters'
    influence.
    """

    fitter: Fitter
    remaining: Tensor
    basis: Tensor

    @staticmethod
    def of(fitter: Fitter, fit: Fit, besides: Sequence[str] = ()) -> _ProjectedRegression:
        """besides: parameters that are not projected out."""
        residual, jacobian = (x[0] for x in fitter.white(fit.linearised))
        kept = [i for i, name in enumerate(fit.space.names) if name not in besides]
        scale, weight, deviation = (x[kept] for x in fitter.priors(fit.space, fit.theta))
        basis, _ = decomposed((jacobian[..., kept] * scale).flatten(0, 1), weight)
        remaining = without(basis, torch.cat([residual.flatten(), -deviation]).unsqueeze(1))
        remaining, basis = (x[: residual.numel()].reshape(*residual.shape, -1) for x in (remaining, basis))
        return _ProjectedRegression(fitter, remaining[..., 0], basis)

    def projected(self, columns: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Whitened changes of the readings by M options (C, M, S), their products with the basis (M, P), and their
        score (M,); columns (S, C, M): these changes."""
        white = self.fitter.whiten(columns).permute(1, 2, 0)
        shared = (white @ self.basis.permute(1, 0, 2)).sum(dim=0)
        return white, shared, (white @ self.remaining.T.unsqueeze(-1)).sum(dim=0).squeeze(-1)

    def screened(self, columns: Tensor) -> tuple[Tensor, Tensor]:
        """Score and strength of M options, (M,) each."""
        white, shared, score = self.projected(columns)
        return score, torch.linalg.vecdot(white, white).sum(dim=0) - torch.linalg.vecdot(shared, shared)


def effect_columns(fitter: Fitter, fit: Fit, options: Sequence[Option]) -> Tensor:
    """Changes of the readings (S, C, M), in their unit, for each start."""
    return _EffectColumns(fitter, fit, options).of(options)


class _EffectColumns:
    """Influence of options on the readings about a fit, with what all options share computed once."""

    def __init__(self, fitter: Fitter, fit: Fit, options: Sequence[Option]) -> None:
        tried = {o.placement.prefix: o.placement for o in options}
        present = [p for p in fit.candidate.placements if p.prefix not in tried]
        self._pieces, self._union = fit.pieces(fit.linearised), fitter.network([*present, *tried.values()])
        self._tried = tried.keys()
        self._forcing = [self._forcing_of(*piece) for piece in self._pieces]
        self._outputs = [engine.look(linearised.levels, theta) for engine, theta, linearised in self._pieces]

    def _forcing_of(self, engine: Collocation, theta: Tensor, linearised: Linearised) -> Forcing:
        values = zip(engine.space.names, theta.flatten().tolist(), strict=True)
        constants = {n: v for n, v in values if n in self._union.constants}
        return Forcing(
            engine.network,
            self._union,
            {p.prefix for p in engine.network.placements} - self._tried,
            self._union.bind(*_named(self._union, constants)),
            linearised.levels[0].T.contiguous(),
            engine.experiment,
        )

    def of(self, options: Sequence[Option]) -> Tensor:
        """Changes of the readings (S, C, M) by some of the options."""
        return with_blanks([self._along(k, options) for k in range(len(self._pieces))], dim=0)

    def _along(self, recording: int, options: Sequence[Option]) -> Tensor:
        """Changes of the readings (S, C, M) of one recording."""
        (engine, theta, linearised), forcing_model = self._pieces[recording], self._forcing[recording]
        experiment, outputs = engine.experiment, self._outputs[recording]
        groups = _groups(options)
        moving = [i for group in groups if options[group[0]].placement.effect.stage is not Stage.READING for i in group]
        columns = theta.new_zeros(len(engine.network.description.sensors), len(options), len(experiment.sample_times))
        forcing = theta.new_zeros(1, linearised.levels.shape[-1], len(moving), len(experiment.steps))
        row = {option: k for k, option in enumerate(moving)}
        for group in groups:
            placement = options[group[0]].placement
            starts = _starts([options[i] for i in group])
            if placement.effect.stage is Stage.READING:
                columns[:, group] = forcing_model.readings(placement, starts)
            else:
                first = row[group[0]]
                forcing[0, :, first : first + len(group)] = forcing_model.rates(placement, starts)
        if moving:
            gain, transition = linearised.gain.permute(0, 2, 3, 1), linearised.transition.permute(0, 2, 3, 1)
            initial = forcing.new_zeros(1, forcing.shape[1], len(moving))
            paths = scan_in_time(transition, forcing, initial, gain)
            columns[:, moving] = outputs.along(paths, [-1] * len(moving))[0]
        return columns.permute(2, 0, 1)


def _named(network: TankNetwork, values: Mapping[str, float]) -> tuple[ParameterSpace, Tensor]:
    space = ParameterSpace(network.constants[n] for n in values)
    return space, space.vector(values).reshape(1, 1, -1)


def _starts(options: Sequence[Option]) -> dict[str, Tensor]:
    """Start values (M, 1) of each parameter, by short name, of M options that fit the same parameters."""
    return {
        ParameterName.parse(name).field: torch.tensor([[o.start[name]] for o in options], dtype=torch.float64)
        for name in options[0].start
    }


def _groups(options: Sequence[Option]) -> list[list[int]]:
    """Indices of options that share place, effect and fitted parameters."""
    groups: dict[tuple[str, ...], list[int]] = {}
    for i, option in enumerate(options):
        groups.setdefault((option.placement.prefix, *sorted(option.start)), []).append(i)
    return list(groups.values())
