"""The library of effects that a gap diagnosis can name, and which of them are physically the same."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from fdi_torch.effects import EFFECTS, effect
from fdi_torch.gap.answer import CauseName
from fdi_torch.names import unknown
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Placement, fits, place_kinds_of

STANDARD = tuple(e.name for e in EFFECTS if e.searched)


def library_of(
    plant: PlantDescription, names: Sequence[str] | None = None, leave_out: Iterable[str] = ()
) -> tuple[Placement, ...]:
    """The effects to search, at all places where they fit.

    Names select effects: 'all' for the whole library, 'pump_lag@Q1' for one place only. Raises ValueError for an
    unknown effect or place.
    """
    wanted = STANDARD if names is None else tuple(e.name for e in EFFECTS) if tuple(names) == ("all",) else names
    left_out = {effect(name).name for name in map(_plain, leave_out)}
    placements: dict[str, Placement] = {}
    for entry in wanted:
        name, separator, at = (part.strip() for part in entry.partition("@"))
        if name == "all":
            raise ValueError(f"library: expected 'all' by itself, got {', '.join(wanted)}")
        if separator and not at:
            raise ValueError(f"library: {entry}: expected a place after the @, got none; name one, or leave the @ out")
        if name in left_out:
            continue
        places = (
            [_known(entry, at, plant)] if at else [p for p in possible_places(plant) if fits(effect(name), plant, p)]
        )
        for place in places:
            if not fits(effect(name), plant, place):
                kinds = " or ".join(place_kinds_of(effect(name)))
                raise ValueError(f"library: {entry}: expected a place of kind {kinds}, got {place}")
            placements[f"{place}.{name}"] = Placement(effect(name), place)
    if not placements:
        raise ValueError("library: expected at least one effect that fits the plant, got none; name some")
    return tuple(placements.values())


def _plain(name: str) -> str:
    """Raises ValueError for an effect with a place, since effects are excluded everywhere."""
    if "@" in name:
        raise ValueError(f"leave-out: expected an effect without a place, got {name}; it is excluded everywhere")
    return name.strip()


def _known(entry: str, place: str, plant: PlantDescription) -> str:
    """A place of the plant; a pair of tanks in either order. Raises ValueError for an unknown place."""
    turned = {f"{b}-{a}": f"{a}-{b}" for a, b in plant.tank_pairs()}
    if (name := turned.get(place, place)) in plant.locations():
        return name
    raise ValueError(f"library: {entry}: {unknown(f'a place of {plant.title}', place, plant.locations())}")


def possible_places(plant: PlantDescription) -> tuple[str, ...]:
    """All components, and the pairs of tanks without a pipe; next to a pipe, a cross flow is a wider pipe."""
    joined = [{p.source, p.target} for p in plant.pipes]
    pairs = {f"{a}-{b}" for a, b in plant.tank_pairs() if {a, b} in joined}
    return tuple(place for place in plant.locations() if place not in pairs)


def tanks_of(place: str, plant: PlantDescription) -> tuple[str, ...]:
    """The tanks whose volumes the flows of a component change; none for a sensor."""
    for component in plant.flow_components():
        if component.name == place:
            return tuple(dict.fromkeys((component.near_tank, component.target)))
    return plant.tanks_at(place)


def equivalence_class(cause: CauseName, plant: PlantDescription, values: Mapping[str, float]) -> frozenset[CauseName]:
    """The cause and all others with the same equations, also through others. values: of a fit, by full name; a
    parameter of the cause without a value may have any.
    """
    name, place = cause
    prefix = f"{place}.{name}."
    pending = {cause: {full.removeprefix(prefix): v for full, v in values.items() if full.startswith(prefix)}}
    same: set[CauseName] = set()
    while pending:
        (name, place), own = pending.popitem()
        same.add((name, place))
        others = effect(name).equivalents(place, plant, own)
        pending |= {c: dict(v) for c, v in others.items() if c not in same}
    return frozenset(same)
