"""Execution of a traced program's sections with torch, operation by operation on all lanes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from torch import Tensor

from fdi_torch.simulate.expression import Varies
from fdi_torch.simulate.operations import OPERATIONS
from fdi_torch.simulate.program import Program
from fdi_torch.simulate.section import Place, Row, Section

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
        self._constants: dict[int, Tensor] = {}
        self._orders: dict[int, list[int]] = {}
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

    def _change(self, row: Row, computed: Mapping[int, Tensor], new_changes: Mapping[Place, Change]) -> Change:
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

    def _evaluate(self, needed: list[int], section: int) -> dict[int, Tensor]:
        nodes = self.program.graph.nodes
        if section not in self._orders:
            self._orders[section] = self.program.graph.reach(needed)
        computed: dict[int, Tensor] = {}
        for i in self._orders[section]:
            if i not in self._constants:
                value = self._compute(i, computed)
                (computed if nodes[i].varies & Varies.STEP else self._constants)[i] = value
            if i in self._constants:
                computed[i] = self._constants[i]
        return computed

    def _compute(self, i: int, computed: Mapping[int, Tensor]) -> Tensor:
        node = self.program.graph.nodes[i]
        if node.operation == "literal":
            return self.lanes.new_tensor(node.value)
        if node.operation == "input":
            table = self._tables.get(node.kind)
            return self.state.values[node.kind, node.index] if table is None else table[node.index]
        return OPERATIONS[node.operation].torch(*(computed[a] for a in node.arguments))
