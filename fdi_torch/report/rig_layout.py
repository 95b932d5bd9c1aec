"""Layout of a rig's drawing: flow directions set the rows, connections the columns."""

from __future__ import annotations

from collections.abc import Iterable

from fdi_torch.plant.description import OUTSIDE, PlantDescription

Place = tuple[int, int]  # row from the top, column from the left


def tank_places(plant: PlantDescription) -> dict[str, Place]:
    """Row and column of every tank, all different.

    A tank is below all tanks that pour into it, beside those with which a pipe levels it, and as close as possible to
    the tanks it is connected to.
    """
    floors = _floors(plant)
    floor_rows = _rows(floors.values(), [(floors[a], floors[b]) for a, b in _falls(plant) if floors[a] != floors[b]])
    rows = {name: floor_rows[floor] for name, floor in floors.items()}
    neighbours = _neighbours(plant)
    places: dict[str, Place] = {}
    for name in _walk(plant, neighbours):
        above = [places[n][1] for n in neighbours[name] if n in places and places[n][0] != rows[name]]
        column = above[0] if above else 1 + max((c for _, c in places.values()), default=-1)
        while (rows[name], column) in places.values():
            column += 1
        places[name] = (rows[name], column)
    return places


def _falls(plant: PlantDescription) -> list[tuple[str, str]]:
    """(upper, lower) tank for every flow in free fall and every overflow."""
    flows = [(c.source, c.target) for c in plant.flow_components() if c.falls and c.target != OUTSIDE]
    return flows + [(t.name, t.overflow_to) for t in plant.tanks if t.overflow_to not in (OUTSIDE, t.name)]


def _floors(plant: PlantDescription) -> dict[str, str]:
    """The first tank with the same zero of the level, for every tank: a flow that depends on both levels has one."""
    floors = {t.name: t.name for t in plant.tanks}
    for c in plant.flow_components():
        if c not in plant.metered_flows() and not c.falls and OUTSIDE not in (c.source, c.target):
            lower = floors[c.target]
            floors = {name: floors[c.source] if floor == lower else floor for name, floor in floors.items()}
    return floors


def _rows(names: Iterable[str], falls: list[tuple[str, str]]) -> dict[str, int]:
    """Length of the longest path down to each tank; cycles are cut after as many steps as there are tanks."""
    rows = dict.fromkeys(names, 0)
    for _ in range(len(rows) - 1):
        for above, below in falls:
            rows[below] = min(max(rows[below], rows[above] + 1), len(rows) - 1)
    return rows


def _neighbours(plant: PlantDescription) -> dict[str, list[str]]:
    joined: dict[str, list[str]] = {t.name: [] for t in plant.tanks}
    ends = [(c.source, c.target) for c in plant.flow_components() if OUTSIDE not in (c.source, c.target)]
    for a, b in ends + _falls(plant):
        if b not in joined[a]:
            joined[a].append(b)
            joined[b].append(a)
    return joined


def _walk(plant: PlantDescription, neighbours: dict[str, list[str]]) -> list[str]:
    """The tanks in order along their connections, each chain starting at one of its ends."""
    ends_first = sorted((t.name for t in plant.tanks), key=lambda name: len(neighbours[name]) > 1)
    order: dict[str, None] = {}
    for start in ends_first:
        pending = [start]
        while pending:
            name = pending.pop()
            if name not in order:
                order[name] = None
                pending += [n for n in reversed(neighbours[name]) if n not in order]
    return list(order)
