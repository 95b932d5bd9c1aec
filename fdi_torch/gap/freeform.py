"""A component's discrepancy without a name: free functions of its own local variables, as effects like any other.

Piecewise linear in what the component can know (a pump its command and its tank's level, a pipe its head, a tank its
level, a sensor its reading) and in time. Coefficients are shares of a typical flow (or reading) with a normal prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.constants import flow_scale, reading_span
from fdi_torch.plant.description import Pipe, PlantDescription, Pump, Sensor
from fdi_torch.plant.effect import Effect, Local, Memory, Placement, Stage, Values, place_kind
from fdi_torch.plant.reach import Range, Reach
from fdi_torch.plant.signals import Clock

LOCAL_NODES, TIME_NODES = 8, 24
PRIOR = 0.2


class _Free(Effect):
    """nodes: for each variable its grid. The coefficient 'head_3' belongs to the fourth node of the head's grid."""

    nodes: dict[str, list[float]]
    scale: float

    def __init__(self, nodes: dict[str, list[float]], scale: float, prior: float = PRIOR) -> None:
        self.nodes, self.scale, self.prior = nodes, scale, prior

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return tuple(
            Parameter(f"{variable}_{j}", "1", 0.0, std=self.prior)
            for variable, grid in self.nodes.items()
            for j in range(len(grid))
        )

    def starts(self, place: str, plant: PlantDescription, reach: Reach) -> list[dict[str, float]]:
        return [{p.name: 0.01} for p in self.parameters(place, plant)]

    def curve(self, variable: str, x: Tensor, p: Values) -> Tensor:
        """The piecewise linear function of x, constant beyond its grid; 0 where the effect has no such variable."""
        grid = self.nodes.get(variable, [])
        total = torch.zeros_like(x)
        for j, node in enumerate(grid):
            width = grid[1] - grid[0]
            hat = 1.0 - torch.abs(x - node) / width
            if j == 0:
                hat = torch.where(x < node, torch.ones_like(hat), hat)
            if j == len(grid) - 1:
                hat = torch.where(x > node, torch.ones_like(hat), hat)
            total = total + p[f"{variable}_{j}"] * torch.clamp(hat, min=0.0)
        return total


class FreeFlow(_Free):
    """A pump or pipe: scale f(head or command) + flow (g(level) + k(t))."""

    name = "free_flow"
    stage = Stage.FLOW
    places: ClassVar[tuple[str, ...]] = ("pump", "pipe", "outlet")

    def flow(self, flow: Tensor, local: Local, p: Values) -> Tensor:
        own = self.curve("command", local.command, p) + self.curve("head", local.head, p)
        factor = self.curve("level", local.level, p) + self.curve("time", local.clock.middle, p)
        return flow + self.scale * own + flow * factor


class FreeInflow(_Free):
    """A tank or a pair of tanks: scale (f(level or difference) + k(t))."""

    name = "free_inflow"
    stage = Stage.BALANCE
    places: ClassVar[tuple[str, ...]] = ("tank", "tank_pair")

    def inflow(self, local: Local, p: Values) -> Tensor:
        own = self.curve("level", local.level, p) + self.curve("difference", local.level - local.far_level, p)
        return self.scale * (own + self.curve("time", local.clock.middle, p))


class FreeArea(_Free):
    """A tank's cross-section: A (1 + f(level))."""

    name = "free_area"
    stage = Stage.STORAGE
    places: ClassVar[tuple[str, ...]] = ("tank",)

    def area(self, area: Tensor, local: Local, p: Values) -> Tensor:
        return area * torch.clamp(1.0 + self.curve("level", local.level, p), min=0.05)


class FreeReading(_Free):
    """A sensor: reading + scale (f(reading) + k(t))."""

    name = "free_reading"
    stage = Stage.READING
    places: ClassVar[tuple[str, ...]] = ("sensor",)

    def reading(self, value: Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[Tensor, Memory]:
        return value + self.scale * (self.curve("reading", value, p) + self.curve("time", clock.end, p)), memory


def free_forms(plant: PlantDescription, reach: Reach, places: Sequence[str]) -> dict[str, tuple[Placement, ...]]:
    """The free discrepancy of each place."""
    return {place: tuple(Placement(e, place) for e in _free_at(place, plant, reach)) for place in places}


def _free_at(place: str, plant: PlantDescription, reach: Reach) -> list[Effect]:
    kind, time = place_kind(plant, place), _grid((0.0, reach.duration), TIME_NODES)
    if kind == "tank_pair":
        first, second = place.split("-")
        ends = reach.levels[first], reach.levels[second]
        span = (ends[0][0] - ends[1][1], ends[0][1] - ends[1][0])
        return [FreeInflow({"difference": _grid(span, LOCAL_NODES), "time": time}, 0.3 * flow_scale(plant, first))]
    if kind == "tank":
        levels, flow = _grid(reach.levels[place], LOCAL_NODES), 0.3 * flow_scale(plant, place)
        return [FreeInflow({"level": levels, "time": time}, flow), FreeArea({"level": levels}, 1.0)]
    component = plant.component(place)
    if isinstance(component, Sensor):
        readings = _grid(reach.readings[place], LOCAL_NODES)
        return [FreeReading({"reading": readings, "time": time}, 0.2 * reading_span(plant, component))]
    if isinstance(component, Pump):
        command = _grid(reach.commands[component.channel], LOCAL_NODES)
        nodes = {"command": command, "level": _grid(reach.levels[component.target], 5), "time": time}
        return [FreeFlow(nodes, component.gain * max(abs(command[0]), abs(command[-1])))]
    assert isinstance(component, Pipe)
    near = reach.levels[component.source]
    far = (0.0, 0.0) if component.is_outlet else reach.levels[component.target]
    heads = (near[0] - far[1], near[1] - far[0]) if not component.is_outlet else near
    flow = 0.5 * flow_scale(plant, component.source)
    return [FreeFlow({"head": _grid(heads, LOCAL_NODES), "time": time}, flow)]


def _grid(span: Range, count: int) -> list[float]:
    low, high = span
    width = max(high - low, 1e-6)
    return [low + width * j / (count - 1) for j in range(count)]
