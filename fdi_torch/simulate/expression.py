"""Expression graphs of pointwise programs, in which equal subexpressions share one node.

Every node states whether its value differs between lanes, between steps, both, or neither. The generated program
computes what does not vary in time once per trajectory, and what does not vary between lanes once for all lanes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from fdi_torch.simulate.operations import FOLDED, OPERATIONS


class Varies:
    """The indices on which a value depends, as bits; plain integers, because operations on an IntFlag are slow."""

    NEVER, LANE, STEP, BOTH = 0, 1, 2, 3


@dataclass(frozen=True)
class Node:
    """operation: a row of OPERATIONS, 'literal' or 'input'. arguments: node numbers. kind and index: name of an
    input.
    """

    operation: str
    arguments: tuple[int, ...]
    varies: int
    value: float | None = None
    kind: str = ""
    index: int = 0

    @property
    def boolean(self) -> bool:
        return self.operation in OPERATIONS and OPERATIONS[self.operation].boolean


class Graph:
    """Nodes in topological order.

    lifted: numbers of the equations that are passed to a program at run time, so that plants that differ only in such
    numbers share one program; simple numbers (halves, small integers) stay in the program. closed: products that are
    needed unchanged elsewhere and are therefore not regrouped with other factors.
    """

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self.lifted: list[float] = []
        self.closed: set[int] = set()
        self._known: dict[tuple[object, ...], int] = {}

    def input(self, kind: str, index: int, varies: int) -> int:
        return self._intern(Node("input", (), varies, None, kind, index))

    def literal(self, value: float) -> int:
        return self._intern(Node("literal", (), Varies.NEVER, float(value)))

    def number(self, value: float) -> int:
        """The node of a number of the equations: a literal if it is simple, else a lifted number."""
        if value * 8 == int(value * 8) and abs(value) <= 64 if abs(value) < 1e18 else False:
            return self.literal(value)
        if value not in self.lifted:
            self.lifted.append(value)
        return self.input("lifted", self.lifted.index(value), Varies.NEVER)

    def value(self, node: int) -> float | None:
        return self.nodes[node].value

    def apply(self, operation: str, *arguments: int) -> int:
        """The node of an operation, simplified where the result is the same up to rounding."""
        values = [self.value(a) for a in arguments]
        if operation in FOLDED and all(v is not None for v in values):
            return self.literal(FOLDED[operation](*values))
        simpler = self._simplify(operation, arguments)
        if simpler is not None:
            return simpler
        varies = Varies.NEVER
        for a in arguments:
            varies |= self.nodes[a].varies
        return self._intern(Node(operation, tuple(arguments), varies))

    def reach(self, outputs: Iterable[int], stop: Iterable[int] = ()) -> list[int]:
        """All nodes on which the outputs depend, in order; arguments of the nodes in `stop` are not followed."""
        ends = set(stop)
        visited: set[int] = set()
        queue = list(outputs)
        while queue:
            node = queue.pop()
            if node not in visited:
                visited.add(node)
                if node not in ends:
                    queue.extend(self.nodes[node].arguments)
        return sorted(visited)

    def substitute(self, outputs: Sequence[int], replacements: Mapping[int, int]) -> list[int]:
        """The outputs with some nodes replaced by others."""
        done = dict(replacements)
        for i in self.reach(outputs, stop=replacements):
            node = self.nodes[i]
            if i not in done:
                arguments = [done[a] for a in node.arguments]
                done[i] = self.apply(node.operation, *arguments) if arguments else i
        return [done[o] for o in outputs]

    def partials(self, outputs: Sequence[int], inputs: Iterable[int]) -> list[dict[int, int]]:
        """For each output, the nodes of its non-zero derivatives by the inputs.

        The inputs may be nodes within the graph; what they depend on counts as constant.
        """
        variables = set(inputs)
        slopes: dict[int, dict[int, int]] = {}
        for i in self.reach(outputs, stop=variables):
            slopes[i] = {i: self.literal(1.0)} if i in variables else self._chain(i, slopes)
        return [slopes[o] for o in outputs]

    def _chain(self, i: int, slopes: Mapping[int, Mapping[int, int]]) -> dict[int, int]:
        """The chain rule at one node: its slopes by the inputs from those of its arguments."""
        node = self.nodes[i]
        if node.operation == "where":
            return self._chain_of_choice(node.arguments, slopes)
        rule = OPERATIONS[node.operation].partials if node.operation in OPERATIONS else None
        if rule is None or not any(slopes[a] for a in node.arguments):
            return {}
        result: dict[int, int] = {}
        for a, factor in zip(node.arguments, rule(self, i, node.arguments), strict=True):
            if factor is None or self.value(factor) == 0.0:
                continue
            for source, slope in slopes[a].items():
                term = self.apply("mul", factor, slope)
                result[source] = self.apply("add", result[source], term) if source in result else term
        return result

    def _chain_of_choice(self, arguments: tuple[int, ...], slopes: Mapping[int, Mapping[int, int]]) -> dict[int, int]:
        """The slopes of a `where`: those of the branch that is taken."""
        condition, yes, no = arguments
        zero = self.literal(0.0)
        sources = dict.fromkeys([*slopes[yes], *slopes[no]])
        return {s: self.apply("where", condition, slopes[yes].get(s, zero), slopes[no].get(s, zero)) for s in sources}

    def _simplify(self, operation: str, a: Sequence[int]) -> int | None:
        value = [self.value(x) for x in a]
        if operation == "mul":
            for x, v in ((a[1], value[0]), (a[0], value[1])):
                if v == 1.0:
                    return x
                if v == -1.0:
                    return self.apply("neg", x)
            grouped = self._negated(operation, a)
            return self._grouped(a) if grouped is None else grouped
        if operation == "add":
            return self._add(a, value)
        if operation == "sub":
            if value[1] == 0.0:
                return a[0]
            if value[0] == 0.0:
                return self.apply("neg", a[1])
            second = self.nodes[a[1]]
            return self.apply("add", a[0], second.arguments[0]) if second.operation == "neg" else None
        if operation == "div":
            return a[0] if value[1] == 1.0 else self._divide(a, value)
        if operation == "neg" and self.nodes[a[0]].operation == "neg":
            return self.nodes[a[0]].arguments[0]
        if operation == "where" and a[1] == a[2]:
            return a[1]
        return None

    def _add(self, a: Sequence[int], value: Sequence[float | None]) -> int | None:
        if value[0] == 0.0:
            return a[1]
        if value[1] == 0.0:
            return a[0]
        if self.nodes[a[1]].operation == "neg":
            return self.apply("sub", a[0], self.nodes[a[1]].arguments[0])
        if self.nodes[a[0]].operation == "neg":
            return self.apply("sub", a[1], self.nodes[a[0]].arguments[0])
        return None

    def _divide(self, a: Sequence[int], value: Sequence[float | None]) -> int | None:
        """A quotient as the product with an inverse that varies less and is therefore computed less often."""
        quartic = self._fourth_root(a[1])
        if quartic is not None and self.nodes[quartic].varies == Varies.BOTH:
            return self.apply("mul", a[0], self.apply("inverse_fourth_root", quartic))
        if value[0] == 1.0 or not self._below(a[1], self.nodes[a[0]].varies):
            return None
        return self.apply("mul", a[0], self.apply("div", self.literal(1.0), a[1]))

    def _grouped(self, a: Sequence[int]) -> int | None:
        """(x c) d = x (c d) if c and d vary less than x, so that c d is computed less often."""
        for product, d in ((a[0], a[1]), (a[1], a[0])):
            if self.nodes[product].operation != "mul" or product in self.closed:
                continue
            first, second = self.nodes[product].arguments
            for x, c in ((first, second), (second, first)):
                often = self.nodes[x].varies
                if self._below(c, often) and self._below(d, often):
                    return self.apply("mul", x, self.apply("mul", c, d))
        return None

    def _below(self, i: int, often: int) -> bool:
        """Whether the node varies with less than `often`."""
        return self.nodes[i].varies | often == often and self.nodes[i].varies != often

    def _fourth_root(self, i: int) -> int | None:
        """The radicand of a node that is a fourth root, else None."""
        root = self.nodes[i]
        inner = self.nodes[root.arguments[0]] if root.operation == "sqrt" else root
        return inner.arguments[0] if root.operation == inner.operation == "sqrt" else None

    def _negated(self, operation: str, a: Sequence[int]) -> int | None:
        """(-x) y = -(x y), so that x y is one node for both signs."""
        for i, x in enumerate(a):
            if self.nodes[x].operation == "neg":
                bare = list(a)
                bare[i] = self.nodes[x].arguments[0]
                return self.apply("neg", self.apply(operation, *bare))
        return None

    def _intern(self, node: Node) -> int:
        arguments = node.arguments
        if node.operation in ("add", "mul", "minimum", "maximum", "eq", "ne", "and", "or"):
            arguments = tuple(sorted(arguments))
        # str() distinguishes 0.0 from -0.0
        key = (node.operation, arguments, str(node.value), node.kind, node.index)
        if key not in self._known:
            self._known[key] = len(self.nodes)
            self.nodes.append(node)
        return self._known[key]


Place = tuple[str, int]


@dataclass(frozen=True)
class Row:
    """One output's change: the sum of coefficient x change of an input, plus one coefficient for each column of
    theta.
    """

    terms: tuple[tuple[int, Place], ...] = ()
    theta: Mapping[int, int] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.terms or self.theta)


@dataclass(frozen=True)
class Output:
    """A result of a section: where it is stored, the node of the graph that computes it, and its change with theta."""

    place: Place
    node: int
    row: Row = Row()


Section = tuple[Output, ...]
