"""Execution of a traced program's sections with torch, operation by operation on all lanes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import cast

from torch import Tensor

from fdi_torch.simulate.expression import Node, Place, Row, Section, Varies
from fdi_torch.simulate.operations import OPERATIONS
from fdi_torch.simulate.program import Program

Change = Tensor | None


@dataclass
class State:
    """Values (L,) and slopes by theta (P, L), by place; a slope of None is zero."""

    values: dict[Place, Tensor] = field(default_factory=dict)
    changes: dict[Place, Change] = field(default_factory=dict)

    def group(self, kind: str, count: int) -> list[tuple[Tensor, Change]]:
        return [(self.values[kind, i], self.changes.get((kind, i))) for i in range(count)]

    def put(self, kind: str, values: list[tuple[Tensor, Change]]) -> None:
        for i, (value, change) in enumerate(values):
            self.values[kind, i], self.changes[kind, i] = value, change


class Interpreter:
    """Runs sections for lanes (L, P) on a state; what does not vary from step to step is computed once.

    nominal (constants,): of the plant, in the order of its parameter space. resolution: see `Experiment`, s.
    """

    def __init__(self, program: Program, lanes: Tensor, nominal: Tensor, resolution: Tensor) -> None:
        self.program, self.lanes, self.state = program, lanes, State()
        self._computed: list[Tensor | None] = [None] * len(program.graph.nodes)
        self._plans: dict[int, _Plan] = {}
        self._tables = {
            "theta": lanes.unbind(-1),
            "nominal": nominal.to(lanes).unbind(),
            "lifted": lanes.new_tensor(program.graph.lifted).unbind(),
            "resolution": [resolution],
        }

    def full(self, change: Change) -> Tensor:
        """The change expanded to (P, L); zeros for None."""
        return self.lanes.new_zeros(self.lanes.shape[::-1]) if change is None else change.expand(self.lanes.shape[::-1])

    def run(self, section: Section) -> None:
        """Compute the outputs of a section and their slopes, and store them; `next_` is dropped from their places."""
        needed = [o.node for o in section]
        needed += [n for o in section for n in [*(c for c, _ in o.row.terms), *o.row.theta.values()]]
        computed = self._evaluate(needed, id(section))
        changes: dict[Place, Change] = {}
        for o in section:
            changes[o.place] = self._change(o.row, computed, changes)
        for (kind, i), node in ((o.place, o.node) for o in section):
            place = (kind.removeprefix("next_"), i)
            self.state.values[place] = computed[node]
            if self.program.tangent:
                self.state.changes[place] = changes[kind, i]

    def _change(self, row: Row, computed: Sequence[Tensor], new_changes: Mapping[Place, Change]) -> Change:
        total: Change = None
        for factor, place in row.terms:
            change = new_changes[place] if place in new_changes else self.state.changes.get(place)
            if change is not None:
                total = computed[factor] * change if total is None else total + computed[factor] * change
        if not row.theta:
            return total
        direct = self.lanes.new_zeros(self.lanes.shape[::-1])
        for q, slope in row.theta.items():
            direct[q] = computed[slope]
        return direct if total is None else total + direct

    def _evaluate(self, needed: list[int], section: int) -> Sequence[Tensor]:
        """The values of all nodes, of which the needed ones are up to date."""
        if section not in self._plans:
            self._plans[section] = self._plan(needed)
        plan, values = self._plans[section], cast(list[Tensor], self._computed)
        for i, place in plan.inputs:
            values[i] = self.state.values[place]
        for i, function, arguments in plan.operations:
            values[i] = function(*[values[a] for a in arguments])
        return values

    def _plan(self, needed: list[int]) -> _Plan:
        """The values that vary from step to step, in order; all others are computed here."""
        plan, graph = _Plan(), self.program.graph
        for i in graph.reach(needed):
            node = graph.nodes[i]
            if not node.varies & Varies.STEP:
                self._computed[i] = self._constant(node) if self._computed[i] is None else self._computed[i]
            elif node.operation == "input":
                plan.inputs.append((i, (node.kind, node.index)))
            else:
                plan.operations.append((i, OPERATIONS[node.operation].torch, node.arguments))
        return plan

    def _constant(self, node: Node) -> Tensor:
        if node.operation == "literal":
            return self.lanes.new_tensor(node.value)
        if node.operation == "input":
            table = self._tables.get(node.kind)
            return self.state.values[node.kind, node.index] if table is None else table[node.index]
        return OPERATIONS[node.operation].torch(*(self._computed[a] for a in node.arguments))


@dataclass
class _Plan:
    """Inputs, and operations with their arguments, by node."""

    inputs: list[tuple[int, Place]] = field(default_factory=list)
    operations: list[tuple[int, Callable[..., Tensor], tuple[int, ...]]] = field(default_factory=list)
