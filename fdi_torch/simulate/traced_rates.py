"""dh/dt of a plant and its derivatives over arrays in time, from one trace of the plant's equations."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

from jaxtyping import Float
from torch import Tensor

from fdi_torch.parameters import by_prefix
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.signals import Clock
from fdi_torch.simulate.array_program import ArrayProgram
from fdi_torch.simulate.expression import Graph, Place, Varies
from fdi_torch.simulate.tracer import Structure, Tracer, structure_of_rates

Entry = tuple[int, int]


@dataclass(frozen=True)
class RateSlopes:
    """Rates (L, n, K), m/s, and their slopes by the state (L, n, n, K), by the commands and by the parameters.

    by_command, by_parameter: (L, K) each, by index of the rate and of the command or parameter; those missing are zero.
    """

    rates: Tensor
    by_state: Tensor
    by_command: Mapping[Entry, Tensor]
    by_parameter: Mapping[Entry, Tensor]


class TracedRates:
    """The rates of a plant's state. names: the parameters that theta holds; all others are nominal."""

    def __init__(self, network: TankNetwork, names: Sequence[str]) -> None:
        self._graph, self.order = Graph(), network.order
        graph, tracer = self._graph, Tracer(self._graph)
        self._state = [graph.input("state", i, Varies.BOTH) for i in range(network.order)]
        self._commands = [graph.input("command", i, Varies.BOTH) for i in range(len(network.actuators()))]
        self._theta = [graph.input("theta", i, Varies.LANE) for i in range(len(names))]
        column = {name: node for name, node in zip(names, self._theta, strict=True)}
        values = {
            name: tracer.tensor(column[name] if name in column else graph.input("nominal", i, Varies.NEVER))
            for i, name in enumerate(network.constants.names)
        }
        start, step = (graph.input("clock", i, Varies.STEP) for i in (0, 1))
        resolution = graph.input("resolution", 0, Varies.STEP)
        clock = Clock(tracer.tensor(start), tracer.tensor(step), tracer.tensor(resolution))
        state, commands = ([tracer.tensor(n) for n in nodes] for nodes in (self._state, self._commands))
        with tracer:
            rates = network.rates(state, commands, clock, by_prefix(values))
        self._rates = [tracer.node(r) for r in rates]
        self._programs: dict[tuple[frozenset[int], frozenset[int]], _Slopes] = {}

    def __call__(
        self,
        state: Float[Tensor, "L n K"],
        commands: Sequence[Float[Tensor, "#L K"]],
        theta: Float[Tensor, "L P"],
        nominal: Float[Tensor, " constants"],
        clock: Clock,
        *,
        driven: Collection[int] = (),
        moved: Collection[int] = (),
    ) -> RateSlopes:
        """Rates and slopes at all steps of the clock.

        state: at mid-step. driven, moved: the commands and the parameters, as columns of theta, by which to
        differentiate. nominal: of the plant's constants.
        """
        lanes, n, steps = state.shape
        slopes = self._slopes(frozenset(driven), frozenset(moved))
        rates, by_state = state.new_empty(lanes, n, steps), state.new_zeros(lanes, n, n, steps)
        others = state.new_empty(len(slopes.by_command) + len(slopes.by_parameter), lanes, steps).unbind()
        into = [*rates.unbind(1), *(by_state[:, i, j] for i, j in slopes.by_state), *others]
        slopes.program.run(self._inputs(state, commands, theta, nominal, clock), into, lanes, steps)
        count = len(slopes.by_command)
        by_command = dict(zip(slopes.by_command, others[:count], strict=True))
        return RateSlopes(rates, by_state, by_command, dict(zip(slopes.by_parameter, others[count:], strict=True)))

    def solve(
        self,
        path: Float[Tensor, "L n nodes"],
        commands: Sequence[Float[Tensor, "#L K"]],
        theta: Float[Tensor, "L P"],
        nominal: Float[Tensor, " constants"],
        clock: Clock,
        guessed: bool,
        tolerance: float,
        rounds: int,
    ) -> bool:
        """Solve trajectories from their first states by the implicit midpoint rule, in place; False without a
        compiler. guessed, tolerance, rounds: see `ArrayProgram.solve_trajectories`."""
        slopes, middle = self._slopes(frozenset(), frozenset()), path.new_empty(path.shape[1], len(clock.step))
        inputs = self._inputs(middle.expand(len(path), -1, -1), commands, theta, nominal, clock)
        spans = clock.step.contiguous()
        return slopes.program.solve_trajectories(
            inputs, middle, slopes.by_state, spans, path, guessed, tolerance, rounds
        )

    def _inputs(
        self, state: Tensor, commands: Sequence[Tensor], theta: Tensor, nominal: Tensor, clock: Clock
    ) -> dict[Place, Tensor]:
        inputs = {("state", i): x for i, x in enumerate(state.unbind(1))}
        inputs |= {("command", i): x for i, x in enumerate(commands)}
        inputs |= {("theta", i): x for i, x in enumerate(theta.unbind(-1))}
        inputs |= {("nominal", i): x for i, x in enumerate(nominal.to(state).unsqueeze(-1).unbind())}
        inputs |= {("lifted", i): x for i, x in enumerate(state.new_tensor(self._graph.lifted).unsqueeze(-1).unbind())}
        inputs |= {("clock", 0): clock.start.unsqueeze(0), ("clock", 1): clock.step.unsqueeze(0)}
        inputs["resolution", 0] = clock.resolution.expand(state.shape[-1]).unsqueeze(0)
        return inputs

    def _slopes(self, driven: frozenset[int], moved: frozenset[int]) -> _Slopes:
        key = driven, moved
        if key not in self._programs:
            kinds = [
                {node: i for i, node in enumerate(self._state)},
                {node: i for i, node in enumerate(self._commands) if i in driven},
                {node: i for i, node in enumerate(self._theta) if i in moved},
            ]
            rows = self._graph.partials(self._rates, [node for kind in kinds for node in kind])
            slopes = [
                {(i, kind[n]): slope for i, row in enumerate(rows) for n, slope in row.items() if n in kind}
                for kind in kinds
            ]
            nodes = [*self._rates, *(node for each in slopes for node in each.values())]
            self._programs[key] = _Slopes(
                list(slopes[0]), list(slopes[1]), list(slopes[2]), ArrayProgram(self._graph, nodes)
            )
        return self._programs[key]


@dataclass(frozen=True)
class _Slopes:
    """The program that computes the rates and then these slopes. Each slope is named by two indices, of its rate and of
    the state, command or parameter."""

    by_state: list[Entry]
    by_command: list[Entry]
    by_parameter: list[Entry]
    program: ArrayProgram


def traced_rates(network: TankNetwork, names: Sequence[str]) -> TracedRates:
    """The traced rates of a plant; plants with the same components and effects share one trace."""
    return _shared(structure_of_rates(network, names), tuple(names))


@lru_cache(maxsize=256)
def _shared(structure: Structure, names: tuple[str, ...]) -> TracedRates:
    return TracedRates(structure.network, names)
