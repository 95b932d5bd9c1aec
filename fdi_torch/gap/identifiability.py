"""What an excitation can never show and never tell apart, whatever the readings turn out to be.

Each effect at its typical size moves the readings by a column of the linearised plant. What is left of it beside the
calibration constants and start levels, over the noise, is how well the effect shows; what is left beside another
effect's column too is how well the two part.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from fdi_torch.effects import effect
from fdi_torch.gap.answer import CauseName
from fdi_torch.gap.candidate_fit import Candidate, Fitter
from fdi_torch.gap.dataset import data_set_of
from fdi_torch.gap.library import canonical, library_of
from fdi_torch.gap.noise_model import Noise
from fdi_torch.gap.screening import Option, Pairs, ScreeningResult, options_of, screen
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.operating_range import operating_range_of
from fdi_torch.recording import Recording

SHOWN = 25.0  # chi-square units: five standard errors
PARTED = 25.0


@dataclass(frozen=True)
class Identifiability:
    """hidden: causes that do not show at their typical size. twins: pairs that do not part, with what parts them in
    chi-square units, the closest first; shown: how well each shows, in the same units."""

    hidden: tuple[CauseName, ...]
    equivalent_causes: tuple[tuple[CauseName, CauseName, float], ...]
    shown: Mapping[CauseName, float]


def identifiability(found: ScreeningResult, plant: PlantDescription) -> Identifiability:
    """From the screen of a library beside the nuisances."""
    pairs = found.pairs
    strength = torch.diagonal(pairs.gram)
    best = _strongest(pairs.options, strength)
    hidden = tuple(cause for cause, i in best.items() if float(strength[i]) < SHOWN)
    return Identifiability(hidden, _twins(plant, best, pairs.gram), {c: float(strength[i]) for c, i in best.items()})


def _strongest(options: Sequence[Option], strength: Tensor) -> dict[CauseName, int]:
    """The start of each cause that shows most."""
    best: dict[CauseName, int] = {}
    for i, option in enumerate(options):
        if option.cause not in best or strength[i] > strength[best[option.cause]]:
            best[option.cause] = i
    return best


def _twins(
    plant: PlantDescription, best: Mapping[CauseName, int], gram: Tensor
) -> tuple[tuple[CauseName, CauseName, float], ...]:
    """Pairs of causes that show, of which one at any size leaves too little of the other."""
    causes = [c for c, i in best.items() if float(gram[i, i]) >= SHOWN]
    found = []
    for k, a in enumerate(causes):
        for b in causes[k + 1 :]:
            i, j = best[a], best[b]
            weaker = min(float(gram[i, i]), float(gram[j, j]))
            left = weaker * (1.0 - float(gram[i, j]) ** 2 / (float(gram[i, i]) * float(gram[j, j])))
            if left < PARTED and canonical(a, plant) != canonical(b, plant):
                found.append((a, b, max(left, 0.0)))
    return tuple(sorted(found, key=lambda pair: pair[2]))


def planned_identifiability(
    plant: PlantDescription, recording: Recording, noise: float, library: Sequence[str] | None = None
) -> Identifiability:
    """recording: planned inputs; what was read, if anything, is not looked at. noise: std of a reading, its unit."""
    nominal_effects = [Placement(effect(p.effect), p.location, p.parameters) for p in plant.effects]
    step = float(torch.median(torch.diff(recording.time)))
    fitter = _noise_free(plant, nominal_effects, recording, step, noise)
    null = fitter.fit(Candidate())
    seen = replace(fitter.data.recording, outputs=null.linearised.readings[0])
    placements = [p for p in library_of(plant, library) if not p.effect.quantizes]
    options = options_of(placements, fitter, operating_range_of(seen, plant))
    return identifiability(screen(fitter, null, options), plant)


def _noise_free(
    plant: PlantDescription, nominal_effects: Sequence[Placement], recording: Recording, step: float, noise: float
) -> Fitter:
    """A fitter whose readings are what the plant file predicts, from its start levels or from rest."""
    sensors = len(plant.sensors)
    names = tuple(s.column for s in plant.sensors)
    units = tuple(s.unit for s in plant.sensors)
    blank = torch.zeros(len(recording), sensors, dtype=torch.float64)
    planned = replace(
        recording, outputs=blank, output_names=names, output_units=units, mask=torch.ones_like(blank, dtype=torch.bool)
    )
    data = data_set_of(plant, nominal_effects, planned, step)
    white = Noise(torch.full((sensors,), noise, dtype=torch.float64), torch.zeros(sensors, dtype=torch.float64))
    engine = Fitter(data, white).engine(Candidate(), ())
    theta = engine.space.nominal().unsqueeze(0)
    readings = engine.converge(theta, engine.constant_guess(theta), rounds=30).readings[0]
    return Fitter(replace(data, readings=readings, recording=replace(planned, outputs=readings)), white)


DRAWS, SEED = 40, 0
PASSES = 0.02  # share of the gap left open by an impostor that a fit test would let pass
SEEN = 1e-6


def simulated_confusions(found: Pairs, named: CauseName, gap: float, plant: PlantDescription) -> dict[str, Any] | None:
    """Of `draws` recordings in which another cause made a gap of this size (chi-square units), how many would have been
    given the name `named`: 'confused' with the true cause in the library, 'passed' without it, with the causes it
    passed for most often. None where no other effect can make such a gap within its range.
    """
    kinds = [canonical(o.cause, plant) for o in found.options]
    ours = canonical(named, plant)
    rivals = [i for i, o in enumerate(found.options) if kinds[i] != ours and _possible(o, found.gram[i, i], gap)]
    if not rivals:
        return None
    scores = _scores(found.gram, rivals, gap)  # (R, D, M)
    strength = torch.diagonal(found.gram)
    gains = torch.where((scores > 0) & (strength > SEEN), scores**2 / strength.clamp(min=SEEN), 0.0)
    mine = torch.tensor([kind == ours for kind in kinds])
    confused, passed = 0, dict.fromkeys((kinds[i] for i in rivals), 0)
    for row, i in enumerate(rivals):
        true = torch.tensor([kind == kinds[i] for kind in kinds])
        best, others = gains[row][:, mine].amax(1), gains[row][:, ~mine & ~true]
        confused += int((gains[row].amax(1) <= best).sum())
        leads = best >= others.amax(1) if others.shape[1] else torch.ones_like(best, dtype=torch.bool)
        passed[kinds[i]] += int((leads & (best > (1.0 - PASSES) * gains[row][:, true].amax(1))).sum())
    worst = sorted((c for c in passed if passed[c]), key=lambda c: -passed[c])[:5]
    return {
        "draws": DRAWS * len(rivals),
        "rivals": len(passed),
        "confused": confused,
        "passed": sum(passed.values()),
        "passed_for": [{"effect": name, "location": at} for name, at in worst],
    }


def _possible(option: Option, strength: Tensor, gap: float) -> bool:
    """Whether the effect can make such a gap within its range, to first order from its start."""
    if float(strength) <= SEEN:
        return False
    name, start = next(iter(option.start.items()))
    size = next(p for p in option.parameters if name.endswith(f".{p.name}"))
    needed = size.nominal + (gap / float(strength)) ** 0.5 * (start - size.nominal)
    return size.low <= needed <= size.high


def _scores(gram: Tensor, rivals: Sequence[int], gap: float) -> Tensor:
    """(R, D, M): what regression on each option's column sees of a rival at the size of the gap, and of the noise."""
    generator = torch.Generator().manual_seed(SEED)
    spectrum, basis = torch.linalg.eigh(gram)
    root = basis * torch.sqrt(spectrum.clamp(min=0.0))
    noise = torch.randn(DRAWS, len(gram), generator=generator, dtype=gram.dtype) @ root.T
    sizes = torch.sqrt(gap / torch.diagonal(gram)[list(rivals)])
    return (sizes.unsqueeze(1) * gram[list(rivals)]).unsqueeze(1) + noise
