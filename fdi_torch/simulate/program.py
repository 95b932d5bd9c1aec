"""A plant's simulation as sections of one expression graph: what to compute before, in and after each step and at
samples.

With `columns` of theta to differentiate by, each section also holds the rows of its Jacobian: the change of its outputs
with its inputs and with theta. Rates are differentiated stage by stage, so that a direction costs a few products.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache

from torch import Tensor

from fdi_torch.parameters import by_prefix
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.signals import Clock
from fdi_torch.simulate.elimination import Elimination, eliminate
from fdi_torch.simulate.expression import Graph, Output, Place, Row, Section, Varies
from fdi_torch.simulate.runge_kutta import Stages, substituted
from fdi_torch.simulate.tracer import Structure, Tracer, structure_of


class Program:
    """The sections of a simulation, each a tuple of outputs.

    prepare: level (of the tanks at t = 0), command_delay, reading_delay. settle_commands, settle_readings: the initial
    memories in steady state; settle_commands also holds the level of the other states. A 'level' is any entry of the
    state vector, of which there are `order`, the `tanks` first. act: action, next_command_memory. stages: stage k's
    levels and then its rates ('slope'), four of each in turn. advance: level. end: slope at the end of the step. read:
    reading, next_reading_memory.

    adaptive: each lane divides the steps of the grid (`step_control.py`). unrolled: there are stages, advance and end,
    which share common subexpressions. If not, there is `law`, evaluated at every stage: the rates ('slope') with their
    direct changes by theta and the actions, and their slopes by the levels ('by_level'), one output per (row, column)
    of `pattern`. late_actuators, late_sensors: indices of those with dead time, in the order of the delays.
    """

    def __init__(
        self, network: TankNetwork, names: tuple[str, ...], tangent: bool, adaptive: bool, unrolled: bool
    ) -> None:
        self.network, self.tangent, self.adaptive, self.unrolled = network, tangent, adaptive, unrolled
        self.columns, self.order, self.tanks = len(names), network.order, len(network.description.tanks)
        self.actuators, self.sensors = len(network.actuators()), len(network.description.sensors)
        self.channels = tuple(channel for _, channel in network.actuators())
        self.sensor_tanks = tuple(network.sensor_tanks())
        self.command_memory, self.reading_memory = network.command_memory, network.reading_memory
        self.graph = Graph()
        self.tracer = Tracer(self.graph)
        self.theta = [self.graph.input("theta", i, Varies.LANE) for i in range(len(names))]
        self.values = self._values(names)
        tensor = self.tracer.tensor
        resolution = self.graph.input("resolution", 0, Varies.NEVER)
        self.span = [self.graph.input("clock", i, Varies.STEP) for i in (0, 1)]
        self.clock = Clock(tensor(self.span[0]), tensor(self.span[1]), tensor(resolution))
        self.prepare, self.late_actuators, self.late_sensors = self._prepare()
        self.settle_commands, self.act = self._commands(self.late_actuators)
        self.stages, self.advance, self.end = self._rates(self.act) if unrolled else ((), (), ())
        self.law, self.pattern = ((), ()) if unrolled else self._law(self.act)
        self.settle_readings, self.read = self._readings()
        del self.tracer, self.values, self.clock  # programs are cached, and the traced tensors would fill the memory

    @cached_property
    def step(self) -> Section:
        """The outputs of a whole step of the grid, in order, if all lanes take the same steps."""
        return self.act + tuple(o for stage in self.stages for o in stage) + self.advance

    @cached_property
    def elimination(self) -> Elimination:
        """The elimination for the levels of an implicit step."""
        return eliminate(self.order, self.pattern)

    def _values(self, names: tuple[str, ...]) -> dict[str, dict[str, Tensor]]:
        """As `TankNetwork.bind`, with inputs of the program in place of numbers."""
        values: dict[str, Tensor] = {}
        for i, name in enumerate(self.network.constants.names):
            node = self.theta[names.index(name)] if name in names else self.graph.input("nominal", i, Varies.NEVER)
            values[name] = self.tracer.tensor(node)
        for name in names:
            self.network.constants.index(name)
        return by_prefix(values)

    def _inputs(self, kind: str, count: int) -> list[int]:
        return [self.graph.input(kind, i, Varies.BOTH) for i in range(count)]

    def _prepare(self) -> tuple[Section, tuple[int, ...], tuple[int, ...]]:
        with self.tracer:
            levels = self.network.start_levels(self.values)
            commands = self.network.command_delays(self.values)
            readings = self.network.reading_delays(self.values)
        late = [("level", list(levels)), ("command_delay", list(commands.values()))]
        late.append(("reading_delay", list(readings.values())))
        outputs = [o for kind, tensors in late for o in self._outputs(kind, [self.tracer.node(t) for t in tensors], {})]
        return tuple(outputs), tuple(commands), tuple(readings)

    def _commands(self, late: Sequence[int]) -> tuple[Section, Section]:
        """Sections of the initial memories and states, and of the actuators' outputs and new memories."""
        graph, network, tensor = self.graph, self.network, self.tracer.tensor
        late_inputs = self._inputs("late_channel", len(late))
        channels = [
            late_inputs[late.index(i)] if i in late else graph.input("channel", channel, Varies.STEP)
            for i, (_, channel) in enumerate(network.actuators())
        ]
        memory = self._inputs("command_memory", network.command_memory)
        levels = self._inputs("level", len(network.description.tanks))
        with self.tracer:
            steady = network.steady_command_memory([tensor(c) for c in channels], self.clock, self.values)
            first_actions, _ = network.commands([tensor(c) for c in channels], steady, self.clock, self.values)
            state = network.with_steady_states([tensor(h) for h in levels], first_actions, self.clock, self.values)
            actions, new_memory = network.commands(
                [tensor(c) for c in channels], tuple(tensor(m) for m in memory), self.clock, self.values
            )
        node = self.tracer.node
        first, following = [node(s) for s in steady], [node(k) for k in new_memory]
        moving = {n: ("late_channel", j) for j, n in enumerate(late_inputs)}
        settle = self._outputs("command_memory", first, moving)
        beside = moving | {n: ("level", i) for i, n in enumerate(levels)}
        rest = self._outputs("level", [node(x) for x in state], beside)[len(levels) :]
        changing = self._changing_inputs(memory, first, following, moving, "command_memory")
        act = self._outputs("action", [node(a) for a in actions], changing)
        return (*settle, *rest), (*act, *self._outputs("next_command_memory", following, changing))

    def _rates(self, act: Section) -> tuple[tuple[Section, ...], Section, Section]:
        """The stages of a step, the levels after it, and the slopes there."""
        graph = self.graph
        actions = [o.node for o in act if o.place[0] == "action"]
        held = [
            graph.input("action", a, Varies.BOTH if graph.nodes[n].varies & Varies.LANE else Varies.STEP)
            for a, n in enumerate(actions)
        ]
        levels = self._inputs("level", self.network.order)
        moving: dict[int, Place] = {n: ("level", i) for i, n in enumerate(levels)}
        moving |= {held[o.place[1]]: o.place for o in act if o.place[0] == "action" and o.row}
        law = self._outputs("slope_right", self._network_rates(levels, held, self.clock), moving)
        stages, advance = Stages(graph, law, levels, self.span[1], dict(zip(held, actions, strict=True))).write()
        uniform = {h: a for h, a in zip(held, actions, strict=True) if not graph.nodes[a].varies & Varies.LANE}
        return stages, advance, tuple(substituted(graph, law, uniform, {}))

    def _law(self, act: Section) -> tuple[Section, tuple[tuple[int, int], ...]]:
        """The rates of the levels, their derivatives by the levels, and which of these derivatives are not zero."""
        levels = self._inputs("level", self.network.order)
        held = self._inputs("action", len(self.network.actuators()))
        clock = self.clock
        if self.adaptive:  # a lane's own steps, which are implicit and therefore stable for every rate of change
            start, step = (self.tracer.tensor(n) for n in self._inputs("part", 2))
            clock = Clock(start, step, clock.resolution, explicit=False)
        rates = self._network_rates(levels, held, clock)
        moving = {held[o.place[1]]: o.place for o in act if o.place[0] == "action" and o.row}
        tank = {n: i for i, n in enumerate(levels)}
        slopes = self.graph.partials(rates, levels) if self.adaptive or self.tangent else []
        by_level = {(i, tank[n]): slope for i, row in enumerate(slopes) for n, slope in row.items()}
        jacobian = [Output(("by_level", e), slope) for e, slope in enumerate(by_level.values())]
        return (*self._outputs("slope", rates, moving), *jacobian), tuple(by_level)

    def _network_rates(self, levels: list[int], held: list[int], clock: Clock) -> list[int]:
        tensor = self.tracer.tensor
        with self.tracer:
            rates = self.network.rates([tensor(h) for h in levels], [tensor(a) for a in held], clock, self.values)
        return [self.tracer.node(r) for r in rates]

    def _readings(self) -> tuple[Section, Section]:
        network, tensor, node = self.network, self.tracer.tensor, self.tracer.node
        measured = self._inputs("seen", len(network.description.sensors))
        memory = self._inputs("reading_memory", network.reading_memory)
        with self.tracer:
            steady = network.steady_reading_memory([tensor(s) for s in measured], self.clock, self.values)
            readings, new_memory = network.read(
                [tensor(s) for s in measured], tuple(tensor(m) for m in memory), self.clock, self.values
            )
        first, following = [node(s) for s in steady], [node(k) for k in new_memory]
        moving = {n: ("seen", i) for i, n in enumerate(measured)}
        changing = self._changing_inputs(memory, first, following, moving, "reading_memory")
        settle = self._outputs("reading_memory", first, moving)
        read = self._outputs("reading", [node(r) for r in readings], changing)
        return tuple(settle), (*read, *self._outputs("next_reading_memory", following, changing))

    def _changing_inputs(
        self, memory: list[int], first: list[int], following: list[int], moving: dict[int, Place], kind: str
    ) -> dict[int, Place]:
        """The inputs that can change with theta: those given, and the memories that depend on them or on theta."""
        changing = dict(moving)
        if not self.tangent:
            return changing
        initial = self._rows(first, moving)
        while True:
            rows = self._rows(following, changing)
            dependent = {memory[i]: (kind, i) for i in range(len(memory)) if rows[i] or initial[i]}
            if dependent.keys() <= changing.keys():
                return changing
            changing |= dependent

    def _outputs(self, kind: str, nodes: list[int], moving: Mapping[int, Place]) -> list[Output]:
        rows = self._rows(nodes, moving)
        return [Output((kind, i), n, row) for i, (n, row) in enumerate(zip(nodes, rows, strict=True))]

    def _rows(self, nodes: list[int], moving: Mapping[int, Place]) -> list[Row]:
        if not self.tangent:
            return [Row() for _ in nodes]
        columns = {n: q for q, n in enumerate(self.theta)}
        return [
            Row(
                tuple((slope, moving[n]) for n, slope in slopes.items() if n in moving),
                {columns[n]: slope for n, slope in slopes.items() if n in columns and n not in moving},
            )
            for slopes in self.graph.partials(nodes, [*moving, *self.theta])
        ]


@lru_cache(maxsize=64)
def build_program(
    network: TankNetwork, names: tuple[str, ...], tangent: bool, adaptive: bool = False, unrolled: bool = True
) -> Program:
    """The program of a plant whose parameters `names` are the columns of theta; tangent: with the Jacobian.

    Adaptive steps are never unrolled. Equal plants share one program.
    """
    return _shared(structure_of(network, names), names, tangent, adaptive, unrolled and not adaptive)


@lru_cache(maxsize=64)
def _shared(structure: Structure, names: tuple[str, ...], tangent: bool, adaptive: bool, unrolled: bool) -> Program:
    return Program(structure.network, names, tangent, adaptive, unrolled)
