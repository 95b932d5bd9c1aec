"""PlantDescription: a rig as plain data in SI.

`TankNetwork` holds the physics. A component's name is also a location for faults and unmodelled effects.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar

from fdi_torch.names import counted, nearest
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.components import COMMAND_UNITS, OUTSIDE, READING_UNITS, Component, Sensor, Tank
from fdi_torch.plant.description_checks import check_names, check_numbers, check_references
from fdi_torch.plant.flow_component import FlowComponent, FlowOrder
from fdi_torch.plant.kinds.pipe import Pipe
from fdi_torch.plant.kinds.pump import Pump
from fdi_torch.plant.kinds.transfer import Transfer
from fdi_torch.plant.kinds.weir import Weir
from fdi_torch.plant.metered_flow import MeteredFlow

if TYPE_CHECKING:
    from torch import Tensor

    from fdi_torch.recording import Hold, Recording

__all__ = [
    "COMMAND_UNITS",
    "FLOW_KINDS",
    "OUTSIDE",
    "READING_UNITS",
    "FaultPriority",
    "Pipe",
    "PlacedEffect",
    "PlantDescription",
    "Pump",
    "Sensor",
    "Tank",
]

Kind = TypeVar("Kind", bound=Component)


def _flows(kind: type[FlowComponent]) -> Any:
    """A field with all flow components of a kind."""
    return field(default=(), metadata={"kind": kind})


@dataclass(frozen=True)
class PlacedEffect:
    """A known effect of the plant, with its parameters (SI); `fdi gap --adopt` adds these."""

    effect: str
    location: str
    parameters: dict[str, float] = field(default_factory=dict)

    @property
    def prefix(self) -> str:
        return f"{self.location}.{self.effect}"

    def full_name(self, parameter: str) -> str:
        """'T1.leak.size' for the parameter 'size' of a leak at T1."""
        return str(ParameterName(self.location, self.effect, parameter))


@dataclass(frozen=True)
class FaultPriority:
    """The importance of a fault to the operators of the rig.

    fault: its size parameter ('T1.leak.size'). smallest: smallest deviation from nominal that the monitor reports, SI.
    urgency: a free word such as high.
    """

    fault: str
    smallest: float = 0.0
    urgency: str = ""


@dataclass(frozen=True, repr=False)
class PlantDescription:
    """A rig: its components, known effects and prior knowledge; gravity m/s^2.

    tolerances: prior standard deviations, of a constant ('P13.discharge_coefficient') relative to its value, of an
    offset, a start level or an effect's parameter ('Q1.pump_lag.time_constant') in its unit. varying: constants that
    differ between recordings, such as the offset of a sensor that is zeroed before each run. matters: smallest
    reported size and urgency of single faults; the monitor reports any other fault at any size. units: units for
    display, see `fdi_torch.quantities.display_in`; they do not count for equality.
    """

    name: str
    tanks: tuple[Tank, ...]
    pipes: tuple[Pipe, ...] = _flows(Pipe)
    pumps: tuple[Pump, ...] = _flows(Pump)
    sensors: tuple[Sensor, ...] = ()
    effects: tuple[PlacedEffect, ...] = ()
    tolerances: dict[str, float] = field(default_factory=dict)
    varying: tuple[str, ...] = ()
    matters: tuple[FaultPriority, ...] = ()
    gravity: float = 9.81
    weirs: tuple[Weir, ...] = _flows(Weir)
    transfers: tuple[Transfer, ...] = _flows(Transfer)
    units: dict[str, str] = field(default_factory=dict, compare=False)

    def __post_init__(self) -> None:
        check_names(self)
        check_references(self)
        check_numbers(self)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name}: {self.counts}>"

    @property
    def counts(self) -> str:
        """'3 tanks, 3 pipes, 2 pumps, 3 sensors': kinds beyond these only if there are any."""
        parts = [(self.tanks, "tank"), *((getattr(self, kind.part()), kind.__name__.lower()) for kind in FLOW_KINDS)]
        parts.append((self.sensors, "sensor"))
        always = ("tank", "pipe", "pump", "sensor")
        return ", ".join(counted(len(each), noun) for each, noun in parts if each or noun in always)

    @property
    def title(self) -> str:
        """'plant bench' in messages; 'plant' for a plant without a name."""
        return "plant" if self.name in ("", "plant") else f"plant {self.name}"

    def components(self) -> Iterator[Tank | FlowComponent | Sensor]:
        yield from self.tanks
        yield from self.flow_components()
        yield from self.sensors

    def flow_components(self) -> Iterator[FlowComponent]:
        """All components that carry a flow, by kind in the order of `FLOW_KINDS`."""
        for kind in FLOW_KINDS:
            yield from getattr(self, kind.part())

    def metered_flows(self) -> list[MeteredFlow]:
        """The pumps and transfers, whose flows are input channels, in the order of their channels."""
        return [c for c in self.flows_in_order if isinstance(c, MeteredFlow)]

    @cached_property
    def flows_in_order(self) -> tuple[FlowComponent, ...]:
        """The flow components in the order in which their flows are computed and their channels are listed.

        Flows that depend on the net inflow of their source follow the water: a flow into a tank precedes one out of it.
        """
        depth = _depths(self)
        return tuple(sorted(self.flow_components(), key=lambda c: (c.order, depth.get(c.name, 0))))

    def component(self, name: str) -> Tank | FlowComponent | Sensor:
        """The component of that name; `tank`, `sensor`, `flow`, `pipe` and `metered_flow` also expect its kind."""
        if (component := self._by_name.get(name)) is not None:
            return component
        near = nearest(name, (component.name for component in self.components()))
        places, pair = (
            (c.name for c in self.components()),
            next((f" or a pair of tanks such as {a}-{b}" for a, b in self.tank_pairs()), ""),
        )
        raise ValueError(f"{self.title}: expected one of {', '.join(places)}{pair}, got {name}{near}")

    @cached_property
    def _by_name(self) -> dict[str, Tank | FlowComponent | Sensor]:
        return {c.name: c for c in self.components()}

    @cached_property
    def _tanks_at(self) -> dict[str, tuple[str, ...]]:
        return {t.name: (t.name,) for t in self.tanks} | {f"{a}-{b}": (a, b) for a, b in self.tank_pairs()}

    def tank(self, name: str) -> Tank:
        return self._of_kind(Tank, name)

    def sensor(self, name: str) -> Sensor:
        return self._of_kind(Sensor, name)

    def flow(self, name: str) -> FlowComponent:
        return self._of_kind(FlowComponent, name)

    def pipe(self, name: str) -> Pipe:
        return self._of_kind(Pipe, name)

    def metered_flow(self, name: str) -> MeteredFlow:
        return self._of_kind(MeteredFlow, name)

    def _of_kind(self, kind: type[Kind], name: str) -> Kind:
        component = self.component(name)
        if not isinstance(component, kind):
            raise ValueError(f"{self.title}: expected the name of a {kind.__name__}, got {name}")
        return component

    def tank_pairs(self) -> tuple[tuple[str, str], ...]:
        """All unordered pairs of tanks; the location of an effect between two tanks is 'T1-T2'."""
        names = [t.name for t in self.tanks]
        return tuple((a, b) for i, a in enumerate(names) for b in names[i + 1 :])

    def tanks_at(self, location: str) -> tuple[str, ...]:
        """The tank of that name, or the two tanks of a pair 'T1-T2'; none for any other place."""
        return self._tanks_at.get(location, ())

    def floor_outlets(self, tank: str) -> tuple[str, ...]:
        """Names of a tank's outlets at its floor without a valve; a leak of the tank is the same as a wider outlet."""
        outlets = (p for p in self.pipes if p.source == tank and p.target == OUTSIDE)
        return tuple(p.name for p in outlets if p.elevation == 0.0 and p.valve is None)

    def locations(self) -> tuple[str, ...]:
        return tuple(c.name for c in self.components()) + tuple(f"{a}-{b}" for a, b in self.tank_pairs())

    def channels(self) -> tuple[str, ...]:
        """The required input channels of a recording: pump commands, valve openings, transfers, without repetition."""
        return tuple(self.channel_units())

    def channel_units(self) -> dict[str, str]:
        """SI unit of each input channel: of a pump's or transfer's command, or 1 for a valve's opening."""
        given = [c.input_channel for c in self.flows_in_order]
        units: dict[str, str] = {}
        for channel, unit in (pair for pair in given if pair is not None):
            units.setdefault(channel, unit)
        return units

    def outputs(self) -> tuple[str, ...]:
        """The output channels of a recording, in the order of the sensors."""
        return tuple(sensor.column for sensor in self.sensors)

    def channel_words(self, channel: str) -> str:
        """The components of a channel, by their names in the plant file: 'hB (LT_101)', or 'h1' if that is both."""
        of_inputs = [c.name for c in self.flows_in_order if (c.input_channel or ("",))[0] == channel]
        names = [s.name for s in self.sensors if s.column == channel] or of_inputs
        return channel if names in ([channel], []) else f"{', '.join(names)} ({channel})"

    def output_units(self) -> dict[str, str]:
        """SI unit of each output channel."""
        return {sensor.column: sensor.unit for sensor in self.sensors}

    def recording(
        self, time: Tensor, inputs: Tensor, outputs: Tensor, *, hold: Hold = "zero_order", source: str = "memory"
    ) -> Recording:
        """The recording of all channels of the plant: time (T,) s, inputs (T, M) and outputs (T, N) in SI."""
        from fdi_torch.recording import Recording  # a module of torch, which plants do without

        units = tuple(self.channel_units().values()), tuple(sensor.unit for sensor in self.sensors)
        return Recording(time, inputs, outputs, self.channels(), self.outputs(), *units, hold=hold, source=source)


def uncertain_constants(plant: PlantDescription, besides: Collection[str] = ()) -> list[str]:
    """The constants with a tolerance, apart from initial levels and from those in `besides`."""
    names = (n for n in plant.tolerances if n not in besides)
    return [n for n in names if ParameterName.parse(n).field != "start_level"]


def with_tolerances(plant: PlantDescription, kept: Callable[[ParameterName], bool]) -> PlantDescription:
    """The plant with those of its tolerances and varying constants whose names are kept."""
    tolerances = {n: std for n, std in plant.tolerances.items() if kept(ParameterName.parse(n))}
    varying = tuple(n for n in plant.varying if kept(ParameterName.parse(n)))
    return replace(plant, tolerances=tolerances, varying=varying)


def with_unlimited_sensors(plant: PlantDescription) -> PlantDescription:
    """The plant with sensors whose readings have no limits."""
    return replace(plant, sensors=tuple(replace(sensor, low=None, high=None) for sensor in plant.sensors))


FLOW_KINDS: tuple[type[FlowComponent], ...] = tuple(
    f.metadata["kind"] for f in fields(PlantDescription) if "kind" in f.metadata
)
"""The kinds of flow component: one field of `PlantDescription` each."""


def _depths(plant: PlantDescription) -> dict[str, int]:
    """Number of flows of its own order that a flow depending on net inflows is behind, at most; circles are cut."""
    flows = [c for c in plant.flow_components() if c.order > FlowOrder.BY_LEVELS]
    depth = {c.name: 0 for c in flows}
    for _ in flows:
        for c in flows:
            before = [depth[o.name] + 1 for o in flows if o.order == c.order and o.target == c.source]
            depth[c.name] = min(max(before, default=0), len(flows))
    return depth
