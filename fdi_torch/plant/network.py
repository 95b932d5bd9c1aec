"""TankNetwork: any network of tanks, flow components and sensors as one differentiable module.

The equations are written per component, so that tracing them gives straight-line pointwise code; every engine runs
this code. All numbers are SI; the leading dimensions of a tensor are batches.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from fdi_torch.parameters import ParameterSpace, by_prefix
from fdi_torch.plant.constants import constant_parameters
from fdi_torch.plant.description import OUTSIDE, PlantDescription
from fdi_torch.plant.effect import Memory, Placement, Stage, Values, expect_fit, placed_parameters
from fdi_torch.plant.flow_component import FlowComponent, FlowOrder
from fdi_torch.plant.local_conditions import Local
from fdi_torch.plant.operating_point import Constants, OperatingPoint, PlaceValues
from fdi_torch.plant.orifice import limit_emptying, weir_flow
from fdi_torch.plant.signal_chain import SignalChain
from fdi_torch.plant.signals import Clock

FlowBefore = tuple[Placement, Tensor, Local]
"""An effect with states, the flow before it (m^3/s; 0 at BALANCE), and its conditions with the states."""


class TankNetwork(nn.Module):
    """The right-hand side and the sensor equations of a plant.

    description: the rig. placements: its faults and unmodelled effects; each is absent while its size is nominal.
    constants: every number that can be estimated, of components and effects. order: number of integrated states; the
    state vector holds the level of each tank and then the states of the effects that have some, all in m.
    """

    nominal: Tensor
    may_overflow = True

    def __init__(self, description: PlantDescription, placements: Iterable[Placement] = ()) -> None:
        super().__init__()
        self.description = description
        self._channel_index = {name: i for i, name in enumerate(description.channels())}
        self._place(tuple(placements))
        for placement in self.placements:
            expect_fit(description, placement)
        effect_parameters = [p for placement in self.placements for p in placed_parameters(placement, description)]
        self.constants = ParameterSpace([*constant_parameters(description), *effect_parameters])
        self.register_buffer("nominal", self.constants.nominal())
        self._first_flows = [c for c in description.flows_in_order if c.order <= FlowOrder.BY_LEVELS]
        self._last_flows = [c for c in description.flows_in_order if c.order > FlowOrder.BY_LEVELS]
        self._tank_index = {tank.name: i for i, tank in enumerate(description.tanks)}

    def restricted_to(self, prefixes: Collection[str]) -> TankNetwork:
        """The same plant and constants with only those placements whose prefix ('T1.leak') is in `prefixes`."""
        other = copy(self)
        other._place(tuple(p for p in self.placements if p.prefix in prefixes))
        return other

    def _place(self, placements: tuple[Placement, ...]) -> None:
        self.placements = placements
        self._by_place: dict[tuple[str, Stage], list[Placement]] = {}
        for placement in placements:
            self._by_place.setdefault((placement.location, placement.effect.stage), []).append(placement)
        self._tanks_at = {p.location: self.description.tanks_at(p.location) for p in placements}
        self._with_states = [p for p in placements if p.effect.states]
        self.order = len(self.description.tanks) + sum(p.effect.states for p in self._with_states)
        self._actuator_names = [name for name, _ in self.actuators()]
        self._command_chain = SignalChain(Stage.COMMAND, self._actuator_names, placements)
        self._reading_chain = SignalChain(Stage.READING, [s.name for s in self.description.sensors], placements)
        self.command_memory, self.reading_memory = self._command_chain.memory, self._reading_chain.memory

    def without_overflow(self) -> TankNetwork:
        """The same plant without the overflow terms, for trajectories that stay below all rims."""
        other = copy(self)
        other.may_overflow = False
        return other

    def bind(self, space: ParameterSpace, theta: Float[Tensor, "*batch P"]) -> PlaceValues:
        """All constants by place and field: from theta where `space` names them, else nominal."""
        named = self.constants.named(self.nominal)
        for name, value in space.named(theta).items():
            self.constants.index(name)
            named[name] = value
        return Constants(by_prefix(named))

    def forward(
        self,
        state: Float[Tensor, "*batch order"],
        commands: Float[Tensor, "*#batch actuators"],
        clock: Clock,
        values: PlaceValues,
    ) -> Float[Tensor, "*batch order"]:
        """Rate of change of the state, m/s. state: as in `rates`. commands: outputs of the actuators."""
        rates = self.rates(state.unbind(-1), commands.unbind(-1), clock, values)
        return torch.stack(torch.broadcast_tensors(*rates), dim=-1)

    def rates(
        self, state: Sequence[Tensor], commands: Sequence[Tensor], clock: Clock, values: PlaceValues
    ) -> list[Tensor]:
        """Rate of change of each entry of the state (*batch), m/s: flows, balances, transfers, weirs and overflow,
        storage, and the states of effects.

        state: `order` numbers (*batch), or the tanks' levels alone, with the effects in steady state.
        """
        point = self.operating_point(state, commands, clock, values)
        net = self.net_inflows(point, self.flows(point))
        states = (rate for rates in self.state_rates(point).values() for rate in rates)
        return [*self.level_rates(point, self.less_overflow(point, net)), *states]

    def operating_point(
        self, state: Sequence[Tensor], commands: Sequence[Tensor], clock: Clock, values: PlaceValues
    ) -> OperatingPoint:
        """What the terms of the equations depend on, at one state (as in `rates`) and one set of commands (*batch)."""
        levels, states = self.split(state)
        by_tank = dict(zip((tank.name for tank in self.description.tanks), levels, strict=True))
        by_actuator = dict(zip(self._actuator_names, commands, strict=True))
        constants = values if isinstance(values, Constants) else Constants(values)
        return OperatingPoint(self.description, by_tank, by_actuator, clock, constants, states)

    def split(self, state: Sequence[Tensor]) -> tuple[Sequence[Tensor], dict[str, tuple[Tensor, ...]]]:
        """The tanks' levels, and the states of each effect by its prefix; none for a state of levels alone."""
        tanks = len(self.description.tanks)
        if len(state) not in (tanks, self.order):
            raise ValueError(f"expected {tanks} levels or a state of {self.order} numbers, got {len(state)}")
        first, states = tanks, {}
        for placement in self._with_states if len(state) > tanks else ():
            states[placement.prefix] = tuple(state[first : first + placement.effect.states])
            first += placement.effect.states
        return state[:tanks], states

    def with_steady_states(
        self, levels: Sequence[Tensor], commands: Sequence[Tensor], clock: Clock, values: PlaceValues
    ) -> list[Tensor]:
        """The state: these levels of the tanks (*batch), m, and the steady states of the effects there."""
        point = self.operating_point(levels, commands, clock, values)
        return [*levels, *(state for states in self.steady_states(point).values() for state in states)]

    def steady_states(self, point: OperatingPoint) -> dict[str, tuple[Tensor, ...]]:
        """States of each effect, m, by its prefix: those of the operating point, or else the steady ones there."""
        return {placement.prefix: local.states for placement, _, local in self._at_states(point)}

    def state_rates(self, point: OperatingPoint) -> dict[str, tuple[Tensor, ...]]:
        """Rates of change of each effect's states, m/s, by its prefix, in the order of the state vector."""
        return {
            placement.prefix: placement.effect.state_rates(flow, local, point.values[placement.prefix])
            for placement, flow, local in self._at_states(point)
        }

    def _at_states(self, point: OperatingPoint) -> list[FlowBefore]:
        """Each effect with states, the flow before it and its conditions, in the order of the state vector."""
        places = {p.location for p in self._with_states}
        flows = [each for c in self._first_flows if c.name in places for each in self._through_effects(point, c)[1]]
        for placement in self._with_states:
            if placement.effect.stage is Stage.BALANCE:
                local = self._at_balance(point, placement)
                flows.append((placement, torch.zeros_like(local.level), local))
        return sorted(flows, key=lambda each: self._with_states.index(each[0]))

    def commands(
        self, channels: Sequence[Tensor], memory: Memory, clock: Clock, values: PlaceValues
    ) -> tuple[list[Tensor], Memory]:
        """COMMAND: mean of each actuator's channel over a step -> mean actuator output, and the new memories."""
        return self._command_chain.propagate(channels, memory, clock, values)

    def steady_command_memory(self, channels: Sequence[Tensor], clock: Clock, values: PlaceValues) -> Memory:
        """The actuators' memories in steady state, after the channels have been constant for a long time."""
        return self._command_chain.steady_memory(channels, clock, values)

    def command_delays(self, values: PlaceValues) -> dict[int, Tensor]:
        """Dead time of each actuator, s, by index into `actuators`; only actuators with a delay effect."""
        return self._command_chain.delays(values)

    def flows(self, point: OperatingPoint) -> dict[str, Tensor]:
        """Flow of each component whose flow does not depend on net inflows, with its FLOW effects, by name, m^3/s."""
        return {component.name: self.flow(point, component) for component in self._first_flows}

    def flow(self, point: OperatingPoint, component: FlowComponent, net: Tensor | None = None) -> Tensor:
        """Flow of one component, m^3/s, positive from source to target: its law, changed by its FLOW effects, limited.

        net: inflow of its source by the flows that are computed before it, m^3/s.
        """
        return self._through_effects(point, component, net)[0]

    def _through_effects(
        self, point: OperatingPoint, component: FlowComponent, net: Tensor | None = None
    ) -> tuple[Tensor, list[FlowBefore]]:
        """FLOW of one component, and what its effects with states see."""
        local = point.at_flow(component, net)
        effects, before = self._effects(component.name, Stage.FLOW, point), []
        for placement, p in effects:
            local = replace(local, head=placement.effect.head(local.head, local, p))
        flow = component.law(local)
        for placement, p in effects:
            own = point.with_states(local, placement, flow)
            if placement.effect.states:
                before.append((placement, flow, own))
            flow = placement.effect.flow(flow, own, p)
        return component.limited(flow, local), before

    def net_inflows(self, point: OperatingPoint, flows: Mapping[str, Tensor]) -> list[Tensor]:
        """BALANCE of each tank before transfers, weirs and overflow: `flows` and BALANCE effects, m^3/s."""
        net = [torch.zeros_like(level) for level in point.levels.values()]
        for component in self._first_flows:
            self.transfer(net, component.source, component.target, flows[component.name])
        for placement in self.placements:
            if placement.effect.stage is Stage.BALANCE:
                self.transfer_by_effect(net, placement, point)
        return net

    def last_flows(self, point: OperatingPoint, net: Sequence[Tensor]) -> tuple[dict[str, Tensor], list[Tensor]]:
        """Flow of each component that depends on the net inflow of its source, and the net inflows after it, m^3/s."""
        inflows, flows = list(net), {}
        for component in self._last_flows:
            flow = self.flow(point, component, inflows[self._tank_index[component.source]])
            self.transfer(inflows, component.source, component.target, flow)
            flows[component.name] = flow
        return flows, inflows

    def less_overflow(self, point: OperatingPoint, net: Sequence[Tensor]) -> list[Tensor]:
        """Net inflow of each tank after transfers, weirs, and overflow over the rims, m^3/s."""
        net = self.last_flows(point, net)[1]
        inflows = list(net)
        for tank, inflow in zip(self.description.tanks, net, strict=True) if self.may_overflow else ():
            constants, level = point.values[tank.name], point.levels[tank.name]
            excess = level - constants["height"]
            spill = weir_flow(excess, inflow, constants["area"], point.rim(tank), point.clock.resolution)
            self.transfer(inflows, tank.name, tank.overflow_to, spill)
        return inflows

    def level_rates(self, point: OperatingPoint, net: Sequence[Tensor]) -> list[Tensor]:
        """STORAGE: dh/dt = net inflow / area(h), limited where a tank runs empty, m/s."""
        rates = []
        for tank, inflow in zip(self.description.tanks, net, strict=True):
            area = point.values[tank.name]["area"]
            for placement, p in self._effects(tank.name, Stage.STORAGE, point):
                area = placement.effect.area(area, point.at_tank(tank.name), p)
            rates.append(limit_emptying(inflow / area, point.levels[tank.name], point.clock.resolution))
        return rates

    def read(
        self, levels: Sequence[Tensor], memory: Memory, clock: Clock, values: PlaceValues
    ) -> tuple[list[Tensor], Memory]:
        """READING: level at each sensor, m, already delayed -> indicated readings in sensor units, and new memories."""
        signals = self._signals(levels, values)
        readings, new_memory = self._reading_chain.propagate(signals, memory, clock, values)
        sensors = self.description.sensors
        return [sensor.clipped(value) for sensor, value in zip(sensors, readings, strict=True)], new_memory

    def steady_reading_memory(self, levels: Sequence[Tensor], clock: Clock, values: PlaceValues) -> Memory:
        """The sensors' memories in steady state, after the levels have been constant for a long time."""
        return self._reading_chain.steady_memory(self._signals(levels, values), clock, values)

    def reading_delays(self, values: PlaceValues) -> dict[int, Tensor]:
        """Dead time of each sensor, s, by its index; only sensors with a delay effect."""
        return self._reading_chain.delays(values)

    def actuators(self) -> list[tuple[str, int]]:
        """Name and input channel index of each component that has an input channel, as in `flows_in_order`."""
        given = [(c.name, c.input_channel) for c in self.description.flows_in_order]
        return [(name, self._channel_index[channel[0]]) for name, channel in given if channel is not None]

    def sensor_tanks(self) -> list[int]:
        return [self._tank_index[s.tank] for s in self.description.sensors]

    def start_levels(self, values: PlaceValues) -> list[Tensor]:
        return [values[tank.name]["start_level"] for tank in self.description.tanks]

    def _signals(self, levels: Sequence[Tensor], values: PlaceValues) -> list[Tensor]:
        """The level at each sensor in the sensor's unit."""
        constants = [values[sensor.name] for sensor in self.description.sensors]
        return [c["gain"] * level + c["offset"] for c, level in zip(constants, levels, strict=True)]

    def _effects(self, location: str, stage: Stage, point: OperatingPoint) -> list[tuple[Placement, Values]]:
        return [(p, point.values[p.prefix]) for p in self._by_place.get((location, stage), ())]

    def transfer(self, net: list[Tensor], source: str, target: str, flow: Tensor) -> None:
        """Subtract a flow (m^3/s) from the source's net inflow and add it to the target's, in place."""
        if source != OUTSIDE:
            net[self._tank_index[source]] = net[self._tank_index[source]] - flow
        if target != OUTSIDE:
            net[self._tank_index[target]] = net[self._tank_index[target]] + flow

    def _at_balance(self, point: OperatingPoint, placement: Placement, net: Sequence[Tensor] | None = None) -> Local:
        """Conditions of a BALANCE effect, with its states. net: inflows that are already computed, m^3/s."""
        tanks = self._tanks_at[placement.location]
        local = point.at_tank(tanks[0], tanks[-1], None if net is None else net[self._tank_index[tanks[0]]])
        return point.with_states(local, placement, torch.zeros_like(local.level))

    def transfer_by_effect(self, net: list[Tensor], placement: Placement, point: OperatingPoint) -> None:
        """Add the flow of a BALANCE effect to the net inflows (m^3/s), in place."""
        parameters = point.values[placement.prefix]
        flow = placement.effect.inflow(self._at_balance(point, placement, net), parameters)
        *first, last = self._tanks_at[placement.location]
        self.transfer(net, first[0] if first else OUTSIDE, last, flow)
        for tank, share in placement.effect.recipients(parameters).items():
            self.transfer(net, tank, OUTSIDE, share * flow)
