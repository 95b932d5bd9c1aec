"""Free discrepancy of a component: piecewise linear functions of its local variables and of time, as effects.

A pump or transfer has functions of its command and its tank's level, a pipe or weir of its head, a tank of its level, a
sensor of its reading. Coefficients are shares of a typical flow (or reading) with a normal prior.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import ClassVar

import torch
from torch import Tensor

from fdi_torch.gap.candidate import Candidate, Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.localization.localized_discrepancy import LocalizedDiscrepancy
from fdi_torch.parameters import Parameter, ParameterName
from fdi_torch.plant.constants import flow_scale, reading_span
from fdi_torch.plant.description import FLOW_KINDS, PlantDescription, Sensor
from fdi_torch.plant.effect import Effect, Local, Memory, Placement, Stage, Values, place_kind
from fdi_torch.plant.flow_component import FlowComponent
from fdi_torch.plant.metered_flow import MeteredFlow
from fdi_torch.plant.operating_range import OperatingRange, Range
from fdi_torch.plant.scales import length_scale, time_scale
from fdi_torch.plant.signals import Clock

LOCAL_NODES, TIME_NODES = 8, 16
HEAD_NODES = 14
PRIOR_STD = 0.2  # standard deviation of a coefficient
MIN_GRID_WIDTH = 1e-6  # width of a grid, in units of the plant's scales or of its largest command
TRIAL_SIZE = 0.01  # size of a coefficient at which its influence on the readings is computed


class _FreeFunctions(Effect):
    """Base of the free discrepancies.

    nodes: grid of each variable. The coefficient 'head_3' belongs to the fourth node of the head's grid.
    """

    nodes: dict[str, list[float]]
    scale: float

    def __init__(
        self, nodes: dict[str, list[float]], scale: float, periods: Sequence[float] = (), prior: float = PRIOR_STD
    ) -> None:
        self.nodes, self.scale, self.periods, self.prior = nodes, scale, tuple(periods), prior

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        names = [f"{variable}_{j}" for variable, grid in self.nodes.items() for j in range(len(grid))]
        names += [f"{wave}_{j}" for j in range(len(self.periods)) for wave in ("cosine", "sine")]
        return tuple(Parameter(name, "1", 0.0, std=self.prior) for name in names)

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        """One start for each coefficient, all of one form, so that they make one batch."""
        names = [p.name for p in self.parameters(place, plant)]
        return [{name: TRIAL_SIZE if name == one else 0.0 for name in names} for one in names]

    def curve(self, variable: str, x: Tensor, p: Values) -> Tensor:
        """Piecewise linear function of x, constant beyond its grid; 0 if the effect has no such variable."""
        if variable not in self.nodes:
            return torch.zeros_like(x)
        grid = self.nodes[variable]
        total = p[f"{variable}_0"] + torch.zeros_like(x)
        for j, (left, right) in enumerate(pairwise(grid)):
            share = torch.clamp((x - left) / (right - left), 0.0, 1.0)
            total = total + (p[f"{variable}_{j + 1}"] - p[f"{variable}_{j}"]) * share
        return total

    def sinusoids(self, clock: Clock, p: Values) -> Tensor | float:
        """Sinusoids of the effect's periods, averaged over each step."""
        total: Tensor | float = 0.0
        for j, period in enumerate(self.periods):
            each = clock.start.new_tensor(period)
            total = total + p[f"sine_{j}"] * clock.sine(each, each.new_tensor(0.0))
            total = total + p[f"cosine_{j}"] * clock.sine(each, each.new_tensor(0.5 * math.pi))
        return total


class FreeFlow(_FreeFunctions):
    """A flow component: scale f(head or command) + flow (g(level) + k(t))."""

    name = "free_flow"
    stage = Stage.FLOW
    places: ClassVar[tuple[str, ...]] = tuple(name for kind in FLOW_KINDS for name in kind.place_kinds)

    def flow(self, flow: Tensor, local: Local, p: Values) -> Tensor:
        local_part = self.curve("command", local.command, p) + self.curve("head", local.head, p)
        time = self.curve("time", local.clock.middle, p) + self.sinusoids(local.clock, p)
        factor = self.curve("level", local.level, p) + time
        return flow + self.scale * local_part + flow * factor


class FreeInflow(_FreeFunctions):
    """Any flow into a tank, scale (f(level) + k(t)), or between two tanks, scale (f(difference of levels) + k(t))."""

    name = "free_inflow"
    stage = Stage.BALANCE
    places: ClassVar[tuple[str, ...]] = ("tank", "tank_pair")

    def inflow(self, local: Local, p: Values) -> Tensor:
        local_part = self.curve("level", local.level, p) + self.curve("difference", local.level - local.far_level, p)
        return self.scale * (local_part + self.curve("time", local.clock.middle, p) + self.sinusoids(local.clock, p))


class FreeArea(_FreeFunctions):
    """A tank's cross-section: A (1 + f(level))."""

    name = "free_area"
    stage = Stage.STORAGE
    places: ClassVar[tuple[str, ...]] = ("tank",)

    def area(self, area: Tensor, local: Local, p: Values) -> Tensor:
        return area * torch.clamp(1.0 + self.curve("level", local.level, p), min=0.05)


class FreeReading(_FreeFunctions):
    """A sensor: reading + scale (f(reading) + k(t))."""

    name = "free_reading"
    stage = Stage.READING
    places: ClassVar[tuple[str, ...]] = ("sensor",)

    def reading(self, value: Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[Tensor, Memory]:
        time = self.curve("time", clock.end, p) + self.sinusoids(clock, p)
        return value + self.scale * (self.curve("reading", value, p) + time), memory


def is_free_coefficient(name: str) -> bool:
    """Whether a parameter is a coefficient of a free discrepancy."""
    return ParameterName.parse(name).effect.startswith("free_")


def free_form(
    place: str, plant: PlantDescription, operating_range: OperatingRange, periods: Sequence[float] = ()
) -> tuple[Placement, ...]:
    """The free discrepancy of a place. periods: of its sinusoids, s."""
    return tuple(Placement(e, place) for e in _free_at(place, plant, operating_range, periods))


def fitted_free_form(
    fitter: Fitter,
    fit: Fit,
    effects: Sequence[Placement],
    unknown: LocalizedDiscrepancy,
    operating_range: OperatingRange,
) -> Fit:
    """Fit free functions for an unknown discrepancy together with some effects of a fit."""
    plant = fitter.data.plant
    placements = [
        p
        for p in free_form(unknown.location, plant, operating_range, unknown.periods)
        if p.effect.quantity in unknown.quantities
    ]
    start = {p.full_name(c.name): 0.0 for p in placements for c in p.effect.parameters(p.location, plant)}
    start |= fit.values_of(effects)
    return fitter.fit(Candidate((*effects, *placements), (start,)), fit)


def discrepancy_tables(fit: Fit) -> dict[str, object]:
    """The fitted discrepancy as tables over its local variables, as multiples of `scale`."""
    values, tables = fit.effect_values, {}
    free = [p for p in fit.candidate.placements if isinstance(p.effect, _FreeFunctions)]
    for placement in free:
        effect = placement.effect
        assert isinstance(effect, _FreeFunctions)
        for variable, grid in effect.nodes.items():
            share = [values[placement.full_name(f"{variable}_{j}")] for j in range(len(grid))]
            tables[f"{effect.name}.{variable}"] = {"at": grid, "share": share, "scale": effect.scale}
        if effect.periods:
            sizes = [
                math.hypot(*(values[placement.full_name(f"{wave}_{j}")] for wave in ("sine", "cosine")))
                for j in range(len(effect.periods))
            ]
            tables[f"{effect.name}.period"] = {"at": list(effect.periods), "share": sizes, "scale": effect.scale}
    return {"location": free[0].location, "tables": tables}


def _free_at(
    place: str, plant: PlantDescription, operating_range: OperatingRange, periods: Sequence[float]
) -> list[Effect]:
    kind, length = place_kind(plant, place), length_scale(plant)
    time = _grid((0.0, operating_range.duration), TIME_NODES, time_scale(plant))
    if kind == "tank_pair":
        first, second = plant.tanks_at(place)
        ends = operating_range.levels[first], operating_range.levels[second]
        grid = _root_grid((ends[0][0] - ends[1][1], ends[0][1] - ends[1][0]), HEAD_NODES, length)
        return [FreeInflow({"difference": grid, "time": time}, 0.3 * flow_scale(plant, first), periods)]
    if kind == "tank":
        levels, flow = _grid(operating_range.levels[place], LOCAL_NODES, length), 0.3 * flow_scale(plant, place)
        return [FreeInflow({"level": levels, "time": time}, flow, periods), FreeArea({"level": levels}, 1.0)]
    component = plant.component(place)
    if isinstance(component, Sensor):
        readings = _grid(operating_range.readings[place], LOCAL_NODES, length if component.unit == "m" else 1.0)
        return [FreeReading({"reading": readings, "time": time}, 0.2 * reading_span(plant, component), periods)]
    if isinstance(component, MeteredFlow):
        command = _grid(operating_range.commands[component.channel], LOCAL_NODES, component.max_flow / component.gain)
        nodes = {
            "command": command,
            "level": _grid(operating_range.levels[component.near_tank], 5, length),
            "time": time,
        }
        return [FreeFlow(nodes, component.gain * max(abs(command[0]), abs(command[-1])), periods)]
    assert isinstance(component, FlowComponent)
    (low, high), *far = (operating_range.levels[tank] for tank in component.depends_on)
    far_low, far_high = far[0] if far else (component.datum, component.datum)
    heads = (low - far_high, high - far_low)
    flow = 0.5 * flow_scale(plant, component.source)
    return [FreeFlow({"head": _root_grid(heads, HEAD_NODES, length), "time": time}, flow, periods)]


def _grid(span: Range, count: int, scale: float) -> list[float]:
    """Even grid over a range, at least MIN_GRID_WIDTH times `scale` wide."""
    low, high = span
    width = max(high - low, MIN_GRID_WIDTH * scale)
    return [low + width * j / (count - 1) for j in range(count)]


def _root_grid(span: Range, count: int, scale: float) -> list[float]:
    """Grid that is even in the signed root of a head, where flows bend most; zero is a node if it lies inside."""
    ends = (math.copysign(math.sqrt(abs(span[0])), span[0]), math.copysign(math.sqrt(abs(span[1])), span[1]))
    roots = _grid(ends, count, math.sqrt(scale))
    if ends[0] < 0.0 < ends[1]:
        nearest = min(range(1, count - 1), key=lambda j: abs(roots[j]))
        roots[nearest] = 0.0
    return [math.copysign(r * r, r) for r in roots]
