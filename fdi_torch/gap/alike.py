"""What components that the plant file describes alike may have in common.

An effect that comes with how a component is built (where a tank runs over) is to be expected at another one of the same
make, though a recording may show it but briefly there, where something else takes its place as well.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import fields, replace

from fdi_torch.effects import effect
from fdi_torch.gap.answer import CauseName
from fdi_torch.gap.fitting import Candidate, Fit, Fitter
from fdi_torch.plant.description import Pipe, PlantDescription, Pump, Sensor, Tank
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.reach import Reach

OF_A_RUN = {"start_level"}  # numbers that say nothing of how a component is built
ROUNDS, SETTLED = 40, 20.0


def alike(plant: PlantDescription, place: str) -> tuple[str, ...]:
    """Other components of the same kind with the same numbers; none for a pair of tanks."""
    if "-" in place and place not in {c.name for c in _components(plant)}:
        return ()
    own = plant.component(place)
    return tuple(c.name for c in _components(plant) if c.name != place and type(c) is type(own) and _same(c, own))


def missing(causes: Iterable[CauseName], plant: PlantDescription) -> list[CauseName]:
    """What comes with the build of a component, is among the causes, and is not at another one that is alike."""
    have = frozenset(causes)
    of_build = [(name, place) for name, place in have if effect(name).of_build]
    wanted = [(name, other) for name, place in sorted(of_build) for other in alike(plant, place)]
    return [cause for cause in dict.fromkeys(wanted) if cause not in have]


def repeated(causes: Iterable[CauseName], plant: PlantDescription) -> int:
    """How many of the causes are at one more component that is alike."""
    left, count = {c for c in causes if effect(c[0]).of_build}, 0
    while left:
        name, place = min(left)
        group = {(name, place), *((name, other) for other in alike(plant, place))} & left
        count, left = count + len(group) - 1, left - group
    return count


def with_repeated(fitter: Fitter, fit: Fit, plant: PlantDescription, reach: Reach) -> list[Fit]:
    """The fit with one more effect, each of those that are missing, begun as it is where it is and from its starts."""
    levels = {t.name: fit.near.levels[0][:, i] for i, t in enumerate(plant.tanks)}
    reached = replace(reach, levels={n: (float(h.min()), float(h.max())) for n, h in levels.items()})
    found = []
    for name, place in missing(fit.key, plant):
        new = Placement(effect(name), place)
        starts = [*_as_elsewhere(fit, new, plant), *new.effect.starts(place, plant, reached)]
        every = tuple(fit.effect_values | {f"{new.prefix}.{n}": v for n, v in start.items()} for start in starts)
        candidate = Candidate((*fit.candidate.placements, new), every)
        found.append(fitter.fit(candidate, fit, rounds=ROUNDS, settled=SETTLED))
    return found


def _as_elsewhere(fit: Fit, new: Placement, plant: PlantDescription) -> list[dict[str, float]]:
    """What the same effect is at components that are alike, as far as its parameters are the same there."""
    known = {p.name for p in new.effect.parameters(new.location, plant)}
    found = []
    for other in alike(plant, new.location):
        prefix = f"{other}.{new.effect.name}."
        values = {n.removeprefix(prefix): v for n, v in fit.effect_values.items() if n.startswith(prefix)}
        found += [{n: v for n, v in values.items() if n in known}] if values else []
    return found


def _components(plant: PlantDescription) -> Sequence[Tank | Pipe | Pump | Sensor]:
    return (*plant.tanks, *plant.pipes, *plant.pumps, *plant.sensors)


def _same(a: Tank | Pipe | Pump | Sensor, b: Tank | Pipe | Pump | Sensor) -> bool:
    numbers = [f.name for f in fields(a) if f.name not in OF_A_RUN]
    pairs = [(getattr(a, n), getattr(b, n)) for n in numbers]
    return all(x == y for x, y in pairs if isinstance(x, float) or isinstance(y, float))
