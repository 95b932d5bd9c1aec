"""The operating point of a plant: levels, commands and constants at one instant, and the conditions at each place."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.plant.constants import inverse_areas, leak_pipe
from fdi_torch.plant.description import OUTSIDE, PlantDescription, Tank
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.flow_component import FlowComponent
from fdi_torch.plant.local_conditions import Local, Values
from fdi_torch.plant.orifice import rim_strength
from fdi_torch.plant.signals import Clock

PlaceValues = Mapping[str, Values]
"""The constants of a plant by place and field."""


class Constants(dict[str, Values]):
    """The constants of a plant by place and field, with a cache for quantities that depend on them alone."""

    def __init__(self, values: PlaceValues) -> None:
        super().__init__(values)
        self._cache: dict[str, tuple[object, Tensor]] = {}

    def cached(self, name: str, compute: Callable[[], Tensor], key: object = None) -> Tensor:
        """Return `compute()`, reusing the last result under `name` while `key` is the same object.

        Results that require gradients are not cached, because autograd can go back through their graph only once.
        """
        last_key, value = self._cache.get(name, (self, None))
        if value is not None and last_key is key:
            return value
        value = compute()
        if not value.requires_grad:
            self._cache[name] = key, value
        return value


@dataclass(frozen=True)
class OperatingPoint:
    """Levels (m) of the tanks and commands after the actuators' effects, in one step of the clock; all (*batch), SI.

    states: of each effect with states, by its prefix ('P12.pipe_inertia'), m.
    """

    plant: PlantDescription
    levels: Mapping[str, Tensor]
    commands: Mapping[str, Tensor]
    clock: Clock
    values: Constants
    states: Mapping[str, tuple[Tensor, ...]]

    @property
    def gravity(self) -> Tensor:
        return self.values[""]["gravity"]

    def at_flow(self, component: FlowComponent, net: Tensor | None = None) -> Local:
        """Conditions at a flow component. net: inflow of its source by the flows that are computed before it, m^3/s."""
        constants, tank = self.values[component.name], component.near_tank
        level = self.levels[tank]
        opening = self.commands.get(component.name)
        local = Local(
            self.clock,
            level,
            torch.zeros_like(level) if component.target == OUTSIDE else self.levels[component.target],
            head=level,
            capacity=self.values.cached(
                f"capacity of {component.name}", lambda: component.capacity(constants, self.gravity)
            ),
            command=self._number(1.0) if opening is None else component.actuated(opening),
            net=self._number(0.0) if net is None else net,
            width=self.width(component),
            height=self.values[tank]["height"],
            area=self.values[tank]["area"],
            gravity=self.gravity,
            constants=constants,
        )
        return replace(local, head=component.head(local))

    def at_tank(self, name: str, far: str | None = None, net: Tensor | None = None) -> Local:
        """Conditions at a tank, or between it and the tank `far`. net: sum of the flows into the tank that are already
        computed, m^3/s.
        """
        constants, level = self.values[name], self.levels[name]
        return Local(
            self.clock,
            level,
            self.levels[far or name],
            head=level,
            capacity=constants["leak_capacity"],
            command=level,
            net=self._number(0.0) if net is None else net,
            width=self.width(leak_pipe(self.plant, name)),
            height=constants["height"],
            area=constants["area"],
            gravity=self.gravity,
            constants=constants,
        )

    def with_states(self, local: Local, placement: Placement, flow: Tensor) -> Local:
        """Conditions of an effect with its states: those of this point, else those in steady state. flow: the flow
        before it, m^3/s.
        """
        effect, prefix = placement.effect, placement.prefix
        if not effect.states:
            return local
        return replace(local, states=self.states.get(prefix) or effect.steady_states(flow, local, self.values[prefix]))

    def width(self, component: FlowComponent) -> Tensor:
        """Head below which the square root of a component's law is smoothed, m."""

        def compute() -> Tensor:
            areas = inverse_areas(self.plant, component)
            width = component.smoothing_width(self.plant.gravity, areas, self.clock.resolution)
            return self.width(leak_pipe(self.plant, component.near_tank)) if width is None else width

        return self.values.cached(f"width of {component.name}", compute, self.clock.resolution)

    def rim(self, tank: Tank) -> Tensor:
        """Weir coefficient of a tank's whole rim: its overflow at 1 m above the rim, m^1.5/s."""
        constants = self.values[tank.name]
        return self.values.cached(f"rim of {tank.name}", lambda: rim_strength(constants["area"], self.gravity))

    def _number(self, value: float) -> Tensor:
        return self.values.cached(f"the number {value}", lambda: torch.full_like(self.gravity, value))
