"""Identifiability of the effects under given inputs: which are hidden, inseparable, or easily confused.

Each effect at its typical size changes the readings by a column of the linearised plant. Its norm in units of the
noise, with calibration constants and initial levels projected out, says how visible the effect is; with another
effect's column projected out as well, how separable the two are.

`planned_identifiability` answers this before any recording, from the prediction of the plant file.

`simulated_confusions` simulates how often another cause would have been named. In turn each other effect of the library
causes a gap of the observed size, with fresh noise, and every effect is fitted to it by linear regression, with and
without the true one in the library. Only single causes are simulated, at their start values, so that these are rates of
a simpler search than the real one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import torch
from torch import Tensor

from fdi_torch.effects import effects_of
from fdi_torch.gap.answer import CauseName
from fdi_torch.gap.candidate import Candidate, Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.channel_noise import Noise
from fdi_torch.gap.dataset import data_set_of
from fdi_torch.gap.extensions import size_of
from fdi_torch.gap.library import equivalence_class, library_of
from fdi_torch.gap.screening import (
    Option,
    Pairs,
    effect_columns,
    most_visible,
    options_of,
    pairs_of,
    products,
    products_of,
    screen,
)
from fdi_torch.gap.start_choice import vector_of
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.operating_range import operating_range_of
from fdi_torch.recording import Recording

VISIBLE = 25.0  # chi-square of a visible effect: five standard errors
SEPARABLE = 25.0  # chi-square that separates two effects


@dataclass(frozen=True)
class Identifiability:
    """hidden: causes that are invisible at their typical size. inseparable: pairs of nearly collinear causes, with the
    chi-square that separates them, the smallest first. shown: chi-square of each cause."""

    hidden: tuple[CauseName, ...]
    inseparable: tuple[tuple[CauseName, CauseName, float], ...]
    shown: Mapping[CauseName, float]


def identifiability(pairs: Pairs, plant: PlantDescription) -> Identifiability:
    """Identifiability from the regression on pairs of a library."""
    gram, best = pairs.gram, most_visible(pairs.options, torch.diagonal(pairs.gram))
    shown = {cause: float(gram[i, i]) for cause, i in best.items()}
    inseparable = []
    for a, b in combinations((c for c in shown if shown[c] >= VISIBLE), 2):
        shared = float(gram[best[a], best[b]]) ** 2 / (shown[a] * shown[b])
        separation = min(shown[a], shown[b]) * (1.0 - shared)
        if separation < SEPARABLE and b not in equivalence_class(a, plant, {}):
            inseparable.append((a, b, max(separation, 0.0)))
    hidden = tuple(cause for cause in shown if shown[cause] < VISIBLE)
    return Identifiability(hidden, tuple(sorted(inseparable, key=lambda pair: pair[2])), shown)


def planned_identifiability(
    plant: PlantDescription, recording: Recording, noise: Sequence[float], library: Sequence[str] | None = None
) -> Identifiability:
    """Identifiability under planned inputs; readings are ignored. noise: standard deviation of each sensor, SI."""
    nominal_effects = effects_of(plant)
    step = float(torch.median(torch.diff(recording.time)))
    fitter = _noise_free(plant, nominal_effects, recording, step, noise)
    nominal_fit = fitter.fit(Candidate())
    predicted = replace(fitter.data.recording, outputs=nominal_fit.linearised.readings[0])
    placements = [p for p in library_of(plant, library) if not p.effect.quantizes]
    options = options_of(placements, fitter, operating_range_of(predicted, plant))
    return identifiability(pairs_of(fitter, nominal_fit, screen(fitter, nominal_fit, options)), plant)


def _noise_free(
    plant: PlantDescription,
    nominal_effects: Sequence[Placement],
    recording: Recording,
    step: float,
    noise: Sequence[float],
) -> Fitter:
    """A fitter whose readings are the plant file's prediction, from its initial levels or from rest."""
    blank = recording.time.new_zeros(len(recording), len(plant.sensors))
    names, units = plant.outputs(), tuple(plant.output_units().values())
    planned = replace(recording, outputs=blank, output_names=names, output_units=units, mask=torch.isfinite(blank))
    data = data_set_of(plant, nominal_effects, planned, step)
    white = Noise.white(torch.tensor(noise, dtype=torch.float64))
    engine = Fitter(data, white).engine(Candidate(), ())
    theta = engine.space.nominal().unsqueeze(0)
    readings = engine.converge(theta).readings[0]
    return Fitter(replace(data, readings=readings, recordings=(replace(planned, outputs=readings),)), white)


def unsearched_equivalents(
    fitter: Fitter, fit: Fit, placed: Placement, options: Sequence[Option], level: float
) -> tuple[CauseName, ...]:
    """Causes outside the library that would explain the readings about as well as a cause of the fit, to first order.

    With equal prior odds each would have more than the share 1 - level of the probability of the two. All columns are
    about the trajectory of the fit, along which effects with the same equations differ by nothing. options: starts of
    these causes.
    """
    own = Option(placed, fit.values_of([placed]))
    _, gram = products(fitter, fit, [own, *options], besides=tuple(own.start))
    shared, strength = gram[0, 1:], torch.diagonal(gram)[1:]
    explained = torch.where(shared > 0.0, shared**2 / strength.clamp(min=LEAST_STRENGTH), 0.0)
    near = float(gram[0, 0]) - explained < 2.0 * math.log(level / (1.0 - level))
    each = zip(options, near, strength, explained, strict=True)
    return tuple(dict.fromkeys(o.cause for o, is_near, s, gap in each if is_near and _possible(o, s, float(gap))))


def exact_areas_like(fitter: Fitter, fit: Fit, explained: Placement | Tensor, level: float) -> dict[str, float]:
    """Cross-sections of tanks without tolerance that would explain the readings about as well as a cause of a fit, to
    first order, by name, with the values that they would need, m^2.

    explained: one of the fit's effects, or what something unknown explains of the readings (S, C). level: as in
    `unsearched_equivalents`. An error of any other constant is itself an effect of the library: plugging, the gain of a
    pump, or the gain or bias of a sensor.
    """
    constants = fitter.network(fit.candidate.placements).constants
    areas = [constants[n] for t in fitter.data.plant.tanks if (n := f"{t.name}.area") not in fit.space]
    if not areas:
        return {}
    engine = fitter.engine(fit.candidate, [*fit.effect_values, *(a.name for a in areas)], [a.name for a in areas])
    theta = vector_of(engine.space, fit.values).unsqueeze(0)
    columns = engine.linearise(theta, fit.linearised.levels).jacobian[0]
    besides: dict[str, float] = {} if isinstance(explained, Tensor) else fit.values_of([explained])
    own = (
        explained
        if isinstance(explained, Tensor)
        else effect_columns(fitter, fit, [Option(explained, besides)])[..., 0]
    )
    _, gram = products_of(fitter, fit, torch.cat([own.unsqueeze(-1), columns], dim=-1), tuple(besides))
    change = gram[0, 1:] / torch.diagonal(gram)[1:].clamp(min=LEAST_STRENGTH)
    left = float(gram[0, 0]) - gram[0, 1:] * change
    near = left < 2.0 * math.log(level / (1.0 - level))
    values = ((a, a.nominal + float(c)) for a, c, is_near in zip(areas, change, near, strict=True) if is_near)
    return {a.name: value for a, value in values if a.low < value < a.high}


DRAWS, SEED = 40, 0
PASSES = 0.02  # share of the gap that a wrong cause may leave if a test of fit shall accept it
LEAST_STRENGTH = 1e-6


def simulated_confusions(pairs: Pairs, named: CauseName, gap: float, plant: PlantDescription) -> dict[str, Any] | None:
    """How often another cause of a gap of this size (chi-square) would have been named `named`.

    'confused': with the true cause in the library. 'passed': without it; 'passed_for' lists the causes for which this
    happens most often. None if no other effect can cause such a gap within its range.
    """
    kinds = [min(equivalence_class(o.cause, plant, {})) for o in pairs.options]
    named_kind = min(equivalence_class(named, plant, {}))
    rivals = [i for i, o in enumerate(pairs.options) if kinds[i] != named_kind and _possible(o, pairs.gram[i, i], gap)]
    if not rivals:
        return None
    noise, strength = _score_noise(pairs.gram), torch.diagonal(pairs.gram)
    is_named = torch.tensor([kind == named_kind for kind in kinds])
    confused, passed = 0, dict.fromkeys((kinds[i] for i in rivals), 0)
    for i in rivals:
        scores = torch.sqrt(gap / strength[i]) * pairs.gram[i] + noise
        gains = torch.where(
            (scores > 0) & (strength > LEAST_STRENGTH), scores**2 / strength.clamp(min=LEAST_STRENGTH), 0.0
        )
        is_true = torch.tensor([kind == kinds[i] for kind in kinds])
        best, others = gains[:, is_named].amax(1), gains[:, ~is_named & ~is_true]
        confused += int((gains.amax(1) <= best).sum())
        wins = best >= others.amax(1) if others.shape[1] else torch.ones_like(best, dtype=torch.bool)
        passed[kinds[i]] += int((wins & (best > (1.0 - PASSES) * gains[:, is_true].amax(1))).sum())
    worst = sorted((c for c in passed if passed[c]), key=lambda c: -passed[c])[:5]
    return {
        "draws": DRAWS * len(rivals),
        "rivals": len(passed),
        "confused": confused,
        "passed": sum(passed.values()),
        "passed_for": [{"effect": name, "location": at} for name, at in worst],
    }


def _possible(option: Option, strength: Tensor, gap: float) -> bool:
    """Whether an effect can cause such a gap within its range, to first order from its start."""
    if float(strength) <= LEAST_STRENGTH:
        return False
    _, start, size = size_of(option)
    needed = size.nominal + (gap / float(strength)) ** 0.5 * (start - size.nominal)
    return size.low <= needed <= size.high


def _score_noise(gram: Tensor) -> Tensor:
    """What the noise of the readings adds to the scores of all options, (DRAWS, M)."""
    generator = torch.Generator().manual_seed(SEED)
    spectrum, basis = torch.linalg.eigh(gram)
    root = basis * torch.sqrt(spectrum.clamp(min=0.0))
    return torch.randn(DRAWS, len(gram), generator=generator, dtype=gram.dtype) @ root.T
