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
from fdi_torch.plant.chain import PlaceValues, SignalChain
from fdi_torch.plant.constants import constant_parameters, inverse_areas, leak_pipe, nominal_capacity
from fdi_torch.plant.description import OUTSIDE, Pipe, PlantDescription, Sensor
from fdi_torch.plant.effect import Effect, Local, Memory, Placement, Stage, Values, fits
from fdi_torch.plant.orifice import orifice_capacity, regular_width, weir_flow
from fdi_torch.plant.signals import Clock

Bound = tuple[Effect, Values]


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
        self._command_chain = SignalChain(Stage.COMMAND, [name for name, _ in self.actuators()], placements)
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
        return values

    def forward(self, levels: Tensor, commands: Tensor, clock: Clock, values: PlaceValues) -> Tensor:
        """dh/dt (*batch, tanks) in m/s; levels (*batch, tanks) in m, commands (*batch, actuators) as they act."""
        rates = self.rates(levels.unbind(-1), commands.unbind(-1), clock, values)
        return torch.stack(torch.broadcast_tensors(*rates), dim=-1)

    def rates(
        self, levels: Sequence[Tensor], commands: Sequence[Tensor], clock: Clock, values: PlaceValues
    ) -> list[Tensor]:
        """The physical stages, in the order water takes; one tensor (*batch) a tank."""
        pumps = self.pump_flows(levels, commands, clock, values)
        pipes = self.pipe_flows(levels, commands, clock, values)
        net = self.net_inflows(levels, pumps, pipes, clock, values)
        return self.level_rates(levels, net, clock, values)

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

    def pump_flows(
        self, levels: Sequence[Tensor], commands: Sequence[Tensor], clock: Clock, values: PlaceValues
    ) -> list[Tensor]:
        """FLOW of each pump, m^3/s."""
        return [self.pump_flow(i, levels, commands, clock, values) for i in range(len(self.description.pumps))]

    def pump_flow(
        self, which: int, levels: Sequence[Tensor], commands: Sequence[Tensor], clock: Clock, values: PlaceValues
    ) -> Tensor:
        """FLOW of one pump: gain x command within [0, max_flow], m^3/s."""
        pump = self.description.pumps[which]
        own, command = values[pump.name], commands[which]
        flow = torch.minimum(torch.clamp(own["gain"] * command, min=0.0), own["max_flow"])
        local = replace(
            self._tank_local(pump.target, levels, clock, values), capacity=own["gain"], command=command, constants=own
        )
        for effect, p in self._effects(pump.name, Stage.FLOW, values):
            flow = effect.flow(flow, local, p)
        return flow

    def pipe_flows(
        self, levels: Sequence[Tensor], commands: Sequence[Tensor], clock: Clock, values: PlaceValues
    ) -> list[Tensor]:
        """FLOW of each pipe and outlet, m^3/s, positive from source to target."""
        return [self.pipe_flow(j, levels, commands, clock, values) for j in range(len(self.description.pipes))]

    def pipe_flow(
        self, which: int, levels: Sequence[Tensor], commands: Sequence[Tensor], clock: Clock, values: PlaceValues
    ) -> Tensor:
        """FLOW of one pipe or outlet by Torricelli's law, m^3/s, positive from source to target."""
        pipe = self.description.pipes[which]
        local = self._pipe_local(pipe, levels, clock, values)
        if pipe.valve:
            before = sum(1 for p in self.description.pipes[:which] if p.valve)
            opening = commands[len(self.description.pumps) + before]
            local = replace(local, command=torch.clamp(opening, 0.0, 1.0))
        effects = self._effects(pipe.name, Stage.FLOW, values)
        for effect, p in effects:
            local = replace(local, head=effect.head(local.head, local, p))
        head = torch.clamp(local.head, min=0.0) if pipe.is_outlet else local.head
        flow = local.capacity * local.command * local.root(head)
        for effect, p in effects:
            flow = effect.flow(flow, local, p)
        return flow

    def net_inflows(
        self,
        levels: Sequence[Tensor],
        pumps: Sequence[Tensor],
        pipes: Sequence[Tensor],
        clock: Clock,
        values: PlaceValues,
    ) -> list[Tensor]:
        """BALANCE of each tank: pumps in, pipes through, faults, and what runs over the rim, m^3/s."""
        return self.spilled(self.gathered(levels, pumps, pipes, clock, values), levels, clock, values)

    def gathered(
        self,
        levels: Sequence[Tensor],
        pumps: Sequence[Tensor],
        pipes: Sequence[Tensor],
        clock: Clock,
        values: PlaceValues,
    ) -> list[Tensor]:
        """Net inflows before anything runs over a rim, m^3/s."""
        net = [torch.zeros_like(level) for level in levels]
        for pump, flow in zip(self.description.pumps, pumps, strict=True):
            self.move(net, OUTSIDE, pump.target, flow)
        for pipe, flow in zip(self.description.pipes, pipes, strict=True):
            self.move(net, pipe.source, pipe.target, flow)
        for placement in self.placements:
            if placement.effect.stage is Stage.BALANCE:
                self.move_by_effect(net, placement, levels, clock, values)
        return net

    def spilled(
        self, net: Sequence[Tensor], levels: Sequence[Tensor], clock: Clock, values: PlaceValues
    ) -> list[Tensor]:
        """Net inflows (m^3/s) less what runs over the rims."""
        if not self.rims:
            return list(net)
        left = list(net)
        for tank, level, inflow in zip(self.description.tanks, levels, net, strict=True):
            own = values[tank.name]
            spill = weir_flow(level - own["height"], inflow, own["area"], values[""]["gravity"], clock.resolution)
            self.move(left, tank.name, tank.overflow_to, spill)
        return left

    def level_rates(
        self, levels: Sequence[Tensor], net: Sequence[Tensor], clock: Clock, values: PlaceValues
    ) -> list[Tensor]:
        """STORAGE: dh/dt = net inflow / area(h); an empty tank cannot lose more, m/s."""
        rates = []
        for i, tank in enumerate(self.description.tanks):
            local = self._tank_local(tank.name, levels, clock, values)
            area = local.constants["area"]
            for effect, p in self._effects(tank.name, Stage.STORAGE, values):
                area = effect.area(area, local, p)
            kept = torch.where(levels[i] <= 0.0, torch.clamp(net[i], min=0.0), net[i])
            rates.append(kept / area)
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

    def _effects(self, location: str, stage: Stage, values: PlaceValues) -> list[Bound]:
        return [(p.effect, values[p.prefix]) for p in self._by_place.get((location, stage), ())]

    def move(self, net: list[Tensor], source: str, target: str, flow: Tensor) -> None:
        """Takes a flow (m^3/s) from one tank's net inflow and adds it to another's, in place; either may be outside."""
        for end, sign in ((source, -1.0), (target, 1.0)):
            if end != OUTSIDE:
                i = self._tank_index[end]
                net[i] = net[i] + sign * flow

    def move_by_effect(
        self, net: list[Tensor], placement: Placement, levels: Sequence[Tensor], clock: Clock, values: PlaceValues
    ) -> None:
        """The same for what flows by a BALANCE effect."""
        ends = placement.location.split("-") if placement.location not in self._tank_index else [placement.location]
        local = self._tank_local(ends[0], levels, clock, values, ends[-1])
        local = replace(local, net=net[self._tank_index[ends[0]]])
        flow = placement.effect.inflow(local, values[placement.prefix])
        self.move(net, *((ends[0], ends[1]) if len(ends) == 2 else (OUTSIDE, ends[0])), flow)
        for tank, share in placement.effect.caught(values[placement.prefix]).items():
            self.move(net, tank, OUTSIDE, share * flow)

    def _pipe_local(self, pipe: Pipe, levels: Sequence[Tensor], clock: Clock, values: PlaceValues) -> Local:
        own = values[pipe.name]
        level = levels[self._tank_index[pipe.source]]
        head = far = level - own["elevation"]
        if pipe.is_outlet:
            far = torch.zeros_like(level) if pipe.target == OUTSIDE else levels[self._tank_index[pipe.target]]
        else:
            far = levels[self._tank_index[pipe.target]]
            wet_far = torch.clamp(far - own["elevation"], min=0.0)
            head = torch.clamp(head, min=0.0) - wet_far if pipe.elevation else level - far
        gravity = values[""]["gravity"]
        return Local(
            clock,
            level,
            far,
            head,
            capacity=orifice_capacity(own["discharge_coefficient"], own["area"], gravity),
            command=torch.ones_like(level),
            net=torch.zeros_like(level),
            width=self._width(pipe, clock),
            height=values[pipe.source]["height"],
            gravity=gravity,
            constants=own,
        )

    def _tank_local(
        self, name: str, levels: Sequence[Tensor], clock: Clock, values: PlaceValues, far: str | None = None
    ) -> Local:
        level = levels[self._tank_index[name]]
        far_level = levels[self._tank_index[far or name]]
        own = values[name]
        return Local(
            clock,
            level,
            far_level,
            head=level,
            capacity=own["leak_capacity"],
            command=level,
            net=torch.zeros_like(level),
            width=self._width(leak_pipe(self.description, name), clock),
            height=own["height"],
            gravity=values[""]["gravity"],
            constants=own,
        )

    def _width(self, pipe: Pipe, clock: Clock) -> Tensor:
        rate = nominal_capacity(self.description, pipe) * inverse_areas(self.description, pipe)
        return regular_width(rate, clock.resolution)


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
