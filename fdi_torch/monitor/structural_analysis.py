"""Structural analysis: which faults are detectable and isolable, from the structure of the equations alone.

Equations and their unknowns form a bipartite graph. Residuals can be formed from its overdetermined part (Dulmage &
Mendelsohn 1958). A fault is detectable if its equation lies there, and isolable from another fault if it still does
after the other's equation is removed (Krysander & Frisk 2008; Definitions 1 and 2 of the 2020 paper).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from scipy.sparse import csr_array
from scipy.sparse.csgraph import maximum_bipartite_matching

from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Placement, Stage, place_kind


@dataclass(frozen=True)
class Structure:
    """equations: name -> its unknowns. faults: name -> the equations that the fault violates."""

    equations: dict[str, frozenset[str]]
    faults: dict[str, frozenset[str]]

    def isolable(self) -> dict[str, dict[str, bool]]:
        """[f][g]: whether f is isolable from g."""
        table: dict[str, dict[str, bool]] = {fault: {} for fault in self.faults}
        for other, removed in self.faults.items():
            remaining = {name: unknowns for name, unknowns in self.equations.items() if name not in removed}
            inside = overdetermined(remaining)
            for fault, violated in self.faults.items():
                table[fault][other] = fault != other and bool(violated & inside)
        return table


def structure_of(plant: PlantDescription, placements: Iterable[Placement]) -> Structure:
    """Structure of a plant: balances, derivatives, flow laws and sensors, with known inputs and readings."""
    equations: dict[str, frozenset[str]] = {}
    for tank in plant.tanks:
        through = [f"q {c.name}" for c in plant.flow_components() if tank.name in (c.source, c.target)]
        equations[f"balance {tank.name}"] = frozenset([f"dh {tank.name}", *through])
        equations[f"derivative {tank.name}"] = frozenset([f"dh {tank.name}", f"h {tank.name}"])
    for c in plant.flow_components():
        equations[f"law {c.name}"] = frozenset([f"q {c.name}", *(f"h {tank}" for tank in c.depends_on)])
    for sensor in plant.sensors:
        equations[f"sensor {sensor.name}"] = frozenset([f"h {sensor.tank}"])
    return Structure(equations, {p.prefix: frozenset(_violated(plant, p)) for p in placements})


def _violated(plant: PlantDescription, placement: Placement) -> list[str]:
    if placement.effect.stage is Stage.BALANCE:
        return [f"balance {tank}" for tank in plant.tanks_at(placement.location)]
    equation = {"tank": "balance", "sensor": "sensor"}.get(place_kind(plant, placement.location), "law")
    return [f"{equation} {placement.location}"]


def overdetermined(equations: dict[str, frozenset[str]]) -> set[str]:
    """The equations of the overdetermined part: those that an alternating path connects to an unmatched equation."""
    matched = matching(equations)  # unknown -> equation
    inside = set(equations) - set(matched.values())
    queue = list(inside)
    while queue:
        for unknown in equations[queue.pop()]:
            partner = matched.get(unknown)
            if partner is not None and partner not in inside:
                inside.add(partner)
                queue.append(partner)
    return inside


def matching(equations: dict[str, frozenset[str]]) -> dict[str, str]:
    """A maximum matching, unknown -> equation."""
    names, unknowns = list(equations), sorted(frozenset().union(*equations.values()))
    table = csr_array([[float(unknown in equations[name]) for unknown in unknowns] for name in names])
    partner = maximum_bipartite_matching(table, perm_type="row")
    return {unknown: names[row] for unknown, row in zip(unknowns, partner.tolist(), strict=True) if row >= 0}
