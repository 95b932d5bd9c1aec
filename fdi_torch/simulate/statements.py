"""The statements of a section in C++: `common` to all lanes, and those of each loop over the vectors of a block."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Sequence

from fdi_torch.simulate.expression import Graph, Varies
from fdi_torch.simulate.guard import guarded
from fdi_torch.simulate.operations import OPERATIONS


class Statements:
    """Writes what computes the nodes of one section, loop after loop.

    constant: where a node that does not vary in time stands, or None before time, when it has to be computed.
    steady: further nodes that stand where `constant` says.
    kept: where a node stands that is needed after its own loop, by node.
    """

    def __init__(
        self, graph: Graph, constant: Callable[[int], str] | None = None, steady: Collection[int] = frozenset()
    ) -> None:
        self.graph, self.constant, self.steady = graph, constant, steady
        self.common: list[str] = []
        self.kept: dict[int, int] = {}
        self._known: set[int] = set()
        self._shared: set[int] = set()
        self._inside = False

    def keep(self, loops: Sequence[list[int]], slopes: Iterable[int]) -> None:
        """Finds what to keep: the slopes, for the loop over directions, and what a loop needs of an earlier one."""
        wanted = [i for i in slopes if self.graph.nodes[i].varies == Varies.BOTH and i not in self.steady]
        known: set[int] = set()
        for loop in loops:
            order = self._order(loop, known)
            wanted += [i for i in order if i in known]
            known |= {i for i in order if self._is_computed(i)}
        self.kept = {i: k for k, i in enumerate(dict.fromkeys(wanted))}

    def compute(self, wanted: Sequence[int]) -> list[str]:
        """The statements of a loop: one for each node that the wanted ones need."""
        self._inside = True
        order = self._order(wanted, self._known)
        for i in order:
            node = self.graph.nodes[i]
            if node.operation != "literal" and not node.varies & Varies.LANE and i not in self._shared:
                self.common.append(f"    const {self._type(i)} v{i} = {self._formula(i)};")
                self._shared.add(i)
        lanes = [i for i in order if self.graph.nodes[i].varies & Varies.LANE]
        lines = self._lanes(lanes, guarded(self.graph, lanes, {*wanted, *self.kept}))
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
                behind = set(self.graph.reach(node.arguments[1:2], stop=[j for j in order if j not in owner]))
                inner = [j for j in order if j in behind - done and owner.get(j) == node.arguments[0]]
            lines += self._guarded(i, inner, order) if inner else [f"        {self._statement(i)}"]
            done |= {*inner}
        return lines

    def _guarded(self, i: int, inner: Sequence[int], order: Sequence[int]) -> list[str]:
        """A `where` whose first branch is computed for vectors in which it is taken."""
        condition, yes, no = self.graph.nodes[i].arguments
        others = {a for j in order if j != i and j not in inner for a in self.graph.nodes[j].arguments}
        lines = [f"        {self._type(j)} v{j};" for j in inner if j in others]
        lines += [f"        Vec v{i} = wide({self.text(no)});", f"        if (ANY({self.text(condition)})) {{"]
        lines += [f"            {self._statement(j, declared=j in others)}" for j in inner]
        return [*lines, f"            v{i} = WHERE({self.text(condition)}, {self.text(yes)}, v{i});", "        }"]

    def leave(self) -> None:
        """From here on, nodes are read where they are stored: a loop has ended."""
        self._inside = False

    def text(self, i: int) -> str:
        """The expression of a node that has been computed; in the loop over directions, of one that was kept."""
        node = self.graph.nodes[i]
        if node.operation == "literal":
            return _literal(node.value)
        if self._inside or not node.varies & Varies.LANE:
            return f"v{i}"
        return self._stored(i)

    def number(self, i: int) -> str:
        """The same as a number."""
        return f"WHERE({self.text(i)}, real(1), real(0))" if self.graph.nodes[i].boolean else self.text(i)

    def _order(self, wanted: Iterable[int], known: set[int]) -> list[int]:
        """What has to be there for the wanted nodes; what is known, or constant, is not followed."""
        if self.constant is None:
            return self.graph.reach(wanted)
        wanted = list(wanted)
        constant = [i for i in self.graph.reach(wanted) if self._is_constant(i)]
        return self.graph.reach(wanted, stop=[*known, *constant])

    def _is_computed(self, i: int) -> bool:
        """Whether a node of a loop is the result of an operation, and not read from where it stands anyway."""
        node = self.graph.nodes[i]
        return node.varies == Varies.BOTH and node.operation != "input" and i not in self.steady

    def _is_constant(self, i: int) -> bool:
        return i in self.steady or not self.graph.nodes[i].varies & Varies.STEP

    def _statement(self, i: int, declared: bool = False) -> str:
        return f"{'' if declared else f'const {self._type(i)} '}v{i} = {self._formula(i)};"

    def _formula(self, i: int) -> str:
        node = self.graph.nodes[i]
        constant = self.constant is not None and self._is_constant(i)
        if node.operation == "input" or i in self._known or constant:
            return self._stored(i)
        return OPERATIONS[node.operation].c.format(*(self.text(a) for a in node.arguments))

    def _stored(self, i: int) -> str:
        """Where a node's value stands in memory."""
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


def stored(where: str, value: str) -> str:
    return f"        AT({where}) = wide({value});"


def _literal(value: float | None) -> str:
    assert value is not None
    return f"real({value!r})" if math.isfinite(value) else f"real({'-' if value < 0 else ''}INFINITY)"


def _input_text(kind: str, index: int, varies: Varies) -> str:
    if kind == "resolution":
        return "b.resolution"
    if kind in ("clock", "channel"):
        return f"{kind}[{index}]"
    return f"AT(b.{kind}[{index}])" if varies & Varies.LANE else f"b.{kind}[{index}]"
