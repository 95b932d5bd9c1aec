"""TankNetwork: any network of tanks, pipes, valves, pumps and sensors as one differentiable module.

The physics is written once, over single components, so that it traces into flat pointwise code; every engine
runs these same lines. All numbers are SI; a tensor's leading dimensions are batches.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from copy import copy
from dataclasses import replace

import torch
from torch import Tensor, nn

from fdi_torch.parameters import Parameter, ParameterSpace
from fdi_torch.plant.chain import SignalChain
from fdi_torch.plant.constants import constant_parameters
from fdi_torch.plant.description import OUTSIDE, Pipe, PlantDescription, Pump, Sensor
from fdi_torch.plant.effect import Effect, Memory, Placement, Stage, Values, fits
from fdi_torch.plant.moment import Constants, Moment, PlaceValues
from fdi_torch.plant.orifice import held, weir_flow
from fdi_torch.plant.signals import Clock


class TankNetwork(nn.Module):
    """The right-hand side and the sensors of a plant.

    description: the rig. placements: faults and unmodelled effects beside the plant's own ones; they are absent
    until a parameter leaves its nominal value. `constants` names every number that can be estimated.
    """

    nominal: Tensor
    rims = True

    def __init__(self, description: PlantDescription, placements: Iterable[Placement] = ()) -> None:
        super().__init__()
        self.description = description
        self._channel_index = {name: i for i, name in enumerate(description.channels())}
        self._place(tuple(placements))
        for placement in self.placements:
            _expect_fit(description, placement)
        effect_parameters = [p for placement in self.placements for p in placed_parameters(placement, description)]
        self.constants = ParameterSpace([*constant_parameters(description), *effect_parameters])
        self.register_buffer("nominal", self.constants.nominal())
        self._tank_index = {tank.name: i for i, tank in enumerate(description.tanks)}

    def showing(self, prefixes: Collection[str]) -> TankNetwork:
        """The same plant with the same constants, of whose placements only some are there."""
        other = copy(self)
        other._place(tuple(p for p in self.placements if p.prefix in prefixes))
        return other

    def _place(self, placements: tuple[Placement, ...]) -> None:
        self.placements = placements
        self._by_place: dict[tuple[str, Stage], list[Placement]] = {}
        for placement in placements:
            self._by_place.setdefault((placement.location, placement.effect.stage), []).append(placement)
        sensors = [sensor.name for sensor in self.description.sensors]
        self._actuator_names = [name for name, _ in self.actuators()]
        self._command_chain = SignalChain(Stage.COMMAND, self._actuator_names, placements)
        self._reading_chain = SignalChain(Stage.READING, sensors, placements)

    def below_rims(self) -> TankNetwork:
        """The same plant where no tank is full, for what never comes to the rims: nothing can run over them."""
        other = copy(self)
        other.rims = False
        return other

    def bind(self, space: ParameterSpace, theta: Tensor) -> PlaceValues:
        """All constants by place and field: columns of theta (*batch, P) where `space` names them, else nominal."""
        values: dict[str, dict[str, Tensor]] = {}
        for name, nominal in zip(self.constants.names, self.nominal.unbind(), strict=True):
            place, _, field = name.rpartition(".")
            values.setdefault(place, {})[field] = nominal
        for name, value in space.named(theta).items():
            self.constants.index(name)
            place, _, field = name.rpartition(".")
            values[place][field] = value
        return Constants(values)

    def forward(self, levels: Tensor, commands: Tensor, clock: Clock, values: PlaceValues) -> Tensor:
        """dh/dt (*batch, tanks) in m/s; levels (*batch, tanks) in m, commands (*batch, actuators) as they act."""
        rates = self.rates(levels.unbind(-1), commands.unbind(-1), clock, values)
        return torch.stack(torch.broadcast_tensors(*rates), dim=-1)

    def rates(
        self, levels: Sequence[Tensor], commands: Sequence[Tensor], clock: Clock, values: PlaceValues
    ) -> list[Tensor]:
        """The physical stages, in the order water takes; one tensor (*batch) a tank."""
        now = self.moment(levels, commands, clock, values)
        pumped = self.pump_flows(now)
        piped = self.pipe_flows(now)
        net = self.gathered(now, pumped, piped)
        kept = self.spilled(now, net)
        return self.level_rates(now, kept)

    def moment(self, levels: Sequence[Tensor], commands: Sequence[Tensor], clock: Clock, values: PlaceValues) -> Moment:
        """What the stages look at: one tensor (*batch) a tank in m, one an actuator."""
        return Moment.of(self.description, levels, self._actuator_names, commands, clock, values)

    def commands(
        self, channels: Sequence[Tensor], memory: Memory, clock: Clock, values: PlaceValues
    ) -> tuple[list[Tensor], Memory]:
        """COMMAND: the channel of each actuator, averaged over a step -> what it makes of it, and the memories."""
        return self._command_chain.through(channels, memory, clock, values)

    def remember_commands(self, channels: Sequence[Tensor], clock: Clock, values: PlaceValues) -> Memory:
        """The actuators' memories after the channels have long been what they are."""
        return self._command_chain.settled(channels, clock, values)

    def command_delays(self, values: PlaceValues) -> dict[int, Tensor]:
        """By how many seconds an actuator (index into `actuators`) is late; only those that can be."""
        return self._command_chain.delays(values)

    def pump_flows(self, now: Moment) -> list[Tensor]:
        """FLOW of each pump, m^3/s."""
        return [self.pump_flow(now, pump) for pump in self.description.pumps]

    def pump_flow(self, now: Moment, pump: Pump) -> Tensor:
        """FLOW of one pump: gain x command within [0, max_flow], m^3/s."""
        own = now.values[pump.name]
        flow = torch.minimum(torch.clamp(own["gain"] * now.commands[pump.name], min=0.0), own["max_flow"])
        for effect, p in self._effects(pump.name, Stage.FLOW, now):
            flow = effect.flow(flow, now.at_pump(pump), p)
        return flow

    def pipe_flows(self, now: Moment) -> list[Tensor]:
        """FLOW of each pipe and outlet, m^3/s, positive from source to target."""
        return [self.pipe_flow(now, pipe) for pipe in self.description.pipes]

    def pipe_flow(self, now: Moment, pipe: Pipe) -> Tensor:
        """FLOW of one pipe or outlet by Torricelli's law, m^3/s, positive from source to target."""
        local = now.at_pipe(pipe)
        effects = self._effects(pipe.name, Stage.FLOW, now)
        for effect, p in effects:
            local = replace(local, head=effect.head(local.head, local, p))
        head = torch.clamp(local.head, min=0.0) if pipe.is_outlet else local.head
        flow = local.capacity * local.command * local.root(head)
        for effect, p in effects:
            flow = effect.flow(flow, local, p)
        return flow

    def gathered(self, now: Moment, pumped: Sequence[Tensor], piped: Sequence[Tensor]) -> list[Tensor]:
        """BALANCE of each tank: pumps in, pipes through, faults; before anything runs over a rim, m^3/s."""
        net = [torch.zeros_like(level) for level in now.levels.values()]
        for pump, flow in zip(self.description.pumps, pumped, strict=True):
            self.move(net, OUTSIDE, pump.target, flow)
        for pipe, flow in zip(self.description.pipes, piped, strict=True):
            self.move(net, pipe.source, pipe.target, flow)
        for placement in self.placements:
            if placement.effect.stage is Stage.BALANCE:
                self.move_by_effect(net, placement, now)
        return net

    def spilled(self, now: Moment, net: Sequence[Tensor]) -> list[Tensor]:
        """Net inflows (m^3/s) less what runs over the rims."""
        kept = list(net)
        for tank, inflow in zip(self.description.tanks, net, strict=True) if self.rims else ():
            own, level = now.values[tank.name], now.levels[tank.name]
            spill = weir_flow(level - own["height"], inflow, own["area"], now.rim(tank), now.clock.resolution)
            self.move(kept, tank.name, tank.overflow_to, spill)
        return kept

    def level_rates(self, now: Moment, net: Sequence[Tensor]) -> list[Tensor]:
        """STORAGE: dh/dt = net inflow / area(h); a tank cannot lose more than it holds, m/s."""
        rates = []
        for tank, inflow in zip(self.description.tanks, net, strict=True):
            area = now.values[tank.name]["area"]
            for effect, p in self._effects(tank.name, Stage.STORAGE, now):
                area = effect.area(area, now.at_tank(tank.name), p)
            rates.append(held(inflow / area, now.levels[tank.name], now.clock.resolution))
        return rates

    def read(
        self, levels: Sequence[Tensor], memory: Memory, clock: Clock, values: PlaceValues
    ) -> tuple[list[Tensor], Memory]:
        """READING: the level at each sensor, late where it is late -> readings in sensor units, and the memories."""
        signals = self._signals(levels, values)
        readings, remembered = self._reading_chain.through(signals, memory, clock, values)
        sensors = self.description.sensors
        return [_clipped(sensor, value) for sensor, value in zip(sensors, readings, strict=True)], remembered

    def remember_readings(self, levels: Sequence[Tensor], clock: Clock, values: PlaceValues) -> Memory:
        """The sensors' memories after the levels have long been what they are."""
        return self._reading_chain.settled(self._signals(levels, values), clock, values)

    def reading_delays(self, values: PlaceValues) -> dict[int, Tensor]:
        """By how many seconds a sensor (index) is late; only those that can be."""
        return self._reading_chain.delays(values)

    def actuators(self) -> list[tuple[str, int]]:
        """Each pump, then each pipe with a valve: its name and its input channel."""
        pumps = [(p.name, self._channel_index[p.channel]) for p in self.description.pumps]
        return pumps + [(p.name, self._channel_index[p.valve]) for p in self.description.pipes if p.valve]

    def sensor_tanks(self) -> list[int]:
        return [self._tank_index[s.tank] for s in self.description.sensors]

    def start_levels(self, values: PlaceValues) -> list[Tensor]:
        return [values[tank.name]["start_level"] for tank in self.description.tanks]

    def command_memory(self) -> int:
        return self._command_chain.memory

    def reading_memory(self) -> int:
        return self._reading_chain.memory

    def _signals(self, levels: Sequence[Tensor], values: PlaceValues) -> list[Tensor]:
        """The level at each sensor in the sensor's unit."""
        owns = [values[sensor.name] for sensor in self.description.sensors]
        return [own["gain"] * level + own["offset"] for own, level in zip(owns, levels, strict=True)]

    def _effects(self, location: str, stage: Stage, now: Moment) -> list[tuple[Effect, Values]]:
        return [(p.effect, now.values[p.prefix]) for p in self._by_place.get((location, stage), ())]

    def move(self, net: list[Tensor], source: str, target: str, flow: Tensor) -> None:
        """Takes a flow (m^3/s) from one tank's net inflow and adds it to another's, in place; either may be outside."""
        if source != OUTSIDE:
            net[self._tank_index[source]] = net[self._tank_index[source]] - flow
        if target != OUTSIDE:
            net[self._tank_index[target]] = net[self._tank_index[target]] + flow

    def move_by_effect(self, net: list[Tensor], placement: Placement, now: Moment) -> None:
        """The same for what flows by a BALANCE effect."""
        at, own = placement.location, now.values[placement.prefix]
        first, last = (at, at) if at in self._tank_index else at.split("-")
        flow = placement.effect.inflow(now.at_tank(first, last, net[self._tank_index[first]]), own)
        self.move(net, *((OUTSIDE, at) if at in self._tank_index else (first, last)), flow)
        for tank, share in placement.effect.caught(own).items():
            self.move(net, tank, OUTSIDE, share * flow)


def _clipped(sensor: Sensor, value: Tensor) -> Tensor:
    return value if sensor.low is None and sensor.high is None else torch.clamp(value, sensor.low, sensor.high)


def placed_parameters(placement: Placement, plant: PlantDescription) -> list[Parameter]:
    """The effect's parameters under their full names, believed to be what the placement says."""
    believed = dict(placement.values or {})
    parameters = []
    for p in placement.effect.parameters(placement.location, plant):
        nominal = believed.pop(p.name, p.nominal)
        low, high = min(p.low, nominal), max(p.high, nominal)
        name = f"{placement.prefix}.{p.name}"
        std = plant.tolerances.get(name, p.std)
        parameters.append(replace(p, name=name, nominal=nominal, low=low, high=high, std=std))
    if believed:
        known = ", ".join(p.name for p in placement.effect.parameters(placement.location, plant))
        raise ValueError(f"{placement.prefix}: expected parameters of {known}, got {', '.join(believed)}")
    return parameters


def _expect_fit(plant: PlantDescription, placement: Placement) -> None:
    if not fits(placement.effect, plant, placement.location):
        wanted = " or ".join(placement.effect.places)
        raise ValueError(f"{placement.prefix}: expected a place of kind {wanted}, got {placement.location}")
