"""The C++ statements of a section: those common to all lanes, and those of each loop over the vectors of a block."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Sequence

from fdi_torch.simulate.expression import Graph, Varies
from fdi_torch.simulate.operations import OPERATIONS

EXPENSIVE = frozenset({"sqrt", "inverse_fourth_root", "div", "exp", "log", "pow", "sin", "cos", "tanh"})


class Statements:
    """Writes the statements that compute the nodes of one section, loop by loop.

    constant: expression for a node that does not vary in time, or None while such nodes are themselves computed.
    kept: index in the storage of nodes that are needed after their loop.
    """

    def __init__(self, graph: Graph, constant: Callable[[int], str] | None = None) -> None:
        self.graph, self.constant = graph, constant
        self.common: list[str] = []
        self.kept: dict[int, int] = {}
        self._known: set[int] = set()
        self._shared: set[int] = set()
        self._inside = False

    def keep(self, loops: Sequence[list[int]], slopes: Iterable[int]) -> None:
        """Select the nodes to store: slopes for the loop over directions, and nodes that later loops need."""
        needed = [i for i in slopes if self.graph.nodes[i].varies == Varies.BOTH]
        computed: set[int] = set()
        for loop in loops:
            order = self._order(loop, computed)
            needed += [i for i in order if i in computed]
            computed |= {i for i in order if self._is_computed(i)}
        self.kept = {i: k for k, i in enumerate(dict.fromkeys(needed))}

    def compute(self, results: Sequence[int]) -> list[str]:
        """The statements of a loop: one for each node on which the results depend."""
        self._inside = True
        order = self._order(results, self._known)
        for i in order:
            node = self.graph.nodes[i]
            if node.operation != "literal" and not node.varies & Varies.LANE and i not in self._shared:
                self.common.append(f"    const {self._type(i)} v{i} = {self._formula(i)};")
                self._shared.add(i)
        lanes = [i for i in order if self.graph.nodes[i].varies & Varies.LANE]
        lines = self._lanes(lanes, guarded(self.graph, lanes, {*results, *self.kept}))
        fresh = [i for i in lanes if i not in self._known]
        lines += [stored(f"kept[{self.kept[i]}]", self.number(i)) for i in fresh if i in self.kept]
        self._known |= {i for i in fresh if self._is_computed(i)}
        return lines

    def _lanes(self, order: Sequence[int], owner: dict[int, int]) -> list[str]:
        lines: list[str] = []
        done: set[int] = set()
        for i in (i for i in order if i not in owner):
            node = self.graph.nodes[i]
            inner = []
            if node.operation == "where" and i not in self._known:
                needed = set(self.graph.reach(node.arguments[1:2], stop=[j for j in order if j not in owner]))
                inner = [j for j in order if j in needed - done and owner.get(j) == node.arguments[0]]
            lines += self._guarded(i, inner, order) if inner else [f"        {self._statement(i)}"]
            done |= {*inner}
        return lines

    def _guarded(self, i: int, inner: Sequence[int], order: Sequence[int]) -> list[str]:
        """A `where` whose first branch is computed only for vectors in which some lane takes it."""
        condition, yes, no = self.graph.nodes[i].arguments
        others = {a for j in order if j != i and j not in inner for a in self.graph.nodes[j].arguments}
        lines = [f"        {self._type(j)} v{j};" for j in inner if j in others]
        lines += [f"        Vec v{i} = wide({self.text(no)});", f"        if (ANY({self.text(condition)})) {{"]
        lines += [f"            {self._statement(j, declared=j in others)}" for j in inner]
        return [*lines, f"            v{i} = WHERE({self.text(condition)}, {self.text(yes)}, v{i});", "        }"]

    def leave(self) -> None:
        """End a loop: from here on, nodes are read from storage."""
        self._inside = False

    def text(self, i: int) -> str:
        """The expression of a computed node; in the loop over directions, of a stored one."""
        node = self.graph.nodes[i]
        if node.operation == "literal":
            return _literal(node.value)
        if self._inside or not node.varies & Varies.LANE:
            return f"v{i}"
        return self._stored(i)

    def number(self, i: int) -> str:
        """The expression of a node as a number, also for truth values."""
        return f"WHERE({self.text(i)}, real(1), real(0))" if self.graph.nodes[i].boolean else self.text(i)

    def _order(self, results: Iterable[int], known: set[int]) -> list[int]:
        """The nodes on which the results depend, in order; known and constant nodes are not followed."""
        if self.constant is None:
            return self.graph.reach(results)
        results = list(results)
        constant = [i for i in self.graph.reach(results) if self._is_constant(i)]
        return self.graph.reach(results, stop=[*known, *constant])

    def _is_computed(self, i: int) -> bool:
        """Whether the node is the result of an operation in a loop."""
        node = self.graph.nodes[i]
        return node.varies == Varies.BOTH and node.operation != "input"

    def _is_constant(self, i: int) -> bool:
        return not self.graph.nodes[i].varies & Varies.STEP

    def _statement(self, i: int, declared: bool = False) -> str:
        return f"{'' if declared else f'const {self._type(i)} '}v{i} = {self._formula(i)};"

    def _formula(self, i: int) -> str:
        node = self.graph.nodes[i]
        constant = self.constant is not None and self._is_constant(i)
        if node.operation == "input" or i in self._known or constant:
            return self._stored(i)
        return OPERATIONS[node.operation].c.format(*(self.text(a) for a in node.arguments))

    def _stored(self, i: int) -> str:
        """The storage location of a node's value."""
        node = self.graph.nodes[i]
        if i in self.kept and (i in self._known or not self._inside):
            text = f"AT(kept[{self.kept[i]}])"
            return f"DIFFERENT({text}, real(0))" if node.boolean else text
        if node.operation == "input":
            return _input_text(node.kind, node.index, node.varies)
        assert self.constant is not None
        return self.constant(i)

    def _type(self, i: int) -> str:
        node = self.graph.nodes[i]
        if node.varies & Varies.LANE:
            return "Mask" if node.boolean else "Vec"
        return "bool" if node.boolean else "real"


def guarded(graph: Graph, order: Sequence[int], outputs: Collection[int]) -> dict[int, int]:
    """Nodes of `order` that matter only where a condition holds -> the node of that condition.

    Such a node is no output, and is used only in the first branch of `where(condition, ...)`, or by other such nodes. A
    level rarely exceeds its rim, so the square roots and quotients of the weir are skipped for a vector of lanes in
    which none does. How lanes share vectors affects what is computed but no result: each lane selects by its own
    condition. Conditions that would save no expensive operation are left out.
    """
    conditions: dict[int, set[int | None]] = {i: {None} for i in outputs}
    owner: dict[int, int] = {}
    for i in reversed(order):
        uses = conditions.get(i, {None})
        sole = next(iter(uses)) if len(uses) == 1 else None
        if sole is not None:
            owner[i] = sole
        node = graph.nodes[i]
        first = node.arguments[1:2] if node.operation == "where" and sole is None else ()
        for position, argument in enumerate(node.arguments):
            conditional = argument in first and position == 1 and node.arguments.count(argument) == 1
            conditions.setdefault(argument, set()).add(node.arguments[0] if conditional else sole)
    worthwhile = {owner[i] for i in owner if graph.nodes[i].operation in EXPENSIVE}
    return {i: c for i, c in owner.items() if c in worthwhile}


def stored(where: str, value: str) -> str:
    return f"        AT({where}) = wide({value});"


def _literal(value: float | None) -> str:
    assert value is not None
    return f"real({value!r})" if math.isfinite(value) else f"real({'-' if value < 0 else ''}INFINITY)"


def _input_text(kind: str, index: int, varies: int) -> str:
    if kind == "resolution":
        return "b.resolution"
    if kind in ("clock", "channel"):
        return f"{kind}[{index}]"
    return f"AT(b.{kind}[{index}])" if varies & Varies.LANE else f"b.{kind}[{index}]"
