"""One step of RK4 by the 3/8 rule as nodes of a graph, in the order of operations of torchdiffeq's `rk4`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from fdi_torch.simulate.expression import Graph, Output, Row, Section

Slopes = tuple[tuple[int, int], ...]


class Stages:
    """Writer of the stages; each stage holds its levels and the rates there.

    law: the rates with their rows, as functions of the nodes `levels`. step: the node of the step's length. replaced:
    further nodes of the law -> the nodes that replace them within a step.
    """

    def __init__(
        self, graph: Graph, law: Sequence[Output], levels: list[int], step: int, replaced: Mapping[int, int]
    ) -> None:
        self.graph, self.law, self.levels, self.step, self.replaced = graph, law, levels, step, replaced
        self.stages: list[Section] = []
        self.tangent = any(o.row for o in law)
        self.third, self.eighth = graph.number(1.0 / 3.0), graph.literal(0.125)

    def write(self) -> tuple[tuple[Section, ...], Section]:
        """The four stages, and the levels after the step."""
        g, h, step, third = self.graph, self.levels, self.step, self.third
        third_step, eighth_step = g.apply("mul", step, third), g.apply("mul", step, self.eighth)
        thrice = g.apply("mul", eighth_step, g.literal(3.0))
        k1 = self._slopes(h, ())
        second = self._each("add", h, self._each("mul", self._times_step(k1), third))
        k2 = self._slopes(second, ((third_step, 1),))
        change = self._each("sub", k2, self._each("mul", k1, third))
        k3 = self._slopes(self._each("add", h, self._times_step(change)), ((g.apply("neg", third_step), 1), (step, 2)))
        change = self._each("add", self._each("sub", k1, k2), k3)
        parts: Slopes = ((step, 1), (g.apply("neg", step), 2), (step, 3))
        k4 = self._slopes(self._each("add", h, self._times_step(change)), parts)
        middle = self._each("mul", self._each("add", k2, k3), g.literal(3.0))
        total = self._each("add", self._each("add", k1, middle), k4)
        after = self._each("add", h, self._each("mul", self._times_step(total), self.eighth))
        parts = ((eighth_step, 1), (thrice, 2), (thrice, 3), (eighth_step, 4))
        advance = tuple(Output(("next_level", i), n, self._level_change(i, parts)) for i, n in enumerate(after))
        return tuple(self.stages), advance

    def _slopes(self, at: list[int], slopes: Slopes) -> list[int]:
        """Add a stage: the rates at the levels `at`, which depend on earlier slopes by the factors `slopes`."""
        stage = len(self.stages)
        reached = [Output((f"stage{stage}", i), n, self._level_change(i, slopes)) for i, n in enumerate(at)]
        replaced = {**self.replaced, **dict(zip(self.levels, at, strict=True))}
        replaced_law = substituted(
            self.graph, self.law, replaced, {("level", i): (f"stage{stage}", i) for i in range(len(at))}
        )
        rates = [Output((f"slope{stage + 1}", o.place[1]), o.node, o.row) for o in replaced_law]
        self.graph.closed |= {o.node for o in rates}
        self.stages.append((*reached, *rates))
        return [o.node for o in rates]

    def _level_change(self, i: int, slopes: Slopes) -> Row:
        """Change of a level within the step: the change at the step's start plus factors times the changes of earlier
        slopes.
        """
        if not self.tangent:
            return Row()
        of_slopes = [(f, (f"slope{k}", i)) for f, k in slopes if self.stages[k - 1][len(self.law) + i].row]
        return Row(((self.graph.literal(1.0), ("level", i)), *of_slopes))

    def _each(self, operation: str, x: list[int], y: list[int] | int) -> list[int]:
        other = y if isinstance(y, list) else [y] * len(x)
        return [self.graph.apply(operation, a, b) for a, b in zip(x, other, strict=True)]

    def _times_step(self, x: list[int]) -> list[int]:
        return self._each("mul", x, self.step)


def substituted(
    graph: Graph,
    section: Sequence[Output],
    replaced: Mapping[int, int],
    renamed: Mapping[tuple[str, int], tuple[str, int]],
) -> list[Output]:
    """The outputs and rows with nodes replaced, and with their changes taken from other places."""
    slopes = [n for o in section for n in (*(c for c, _ in o.row.terms), *o.row.theta.values())]
    nodes = [*(o.node for o in section), *slopes]
    new = dict(zip(nodes, graph.substitute(nodes, replaced), strict=True))
    return [
        Output(
            o.place,
            new[o.node],
            Row(
                tuple((new[c], renamed.get(place, place)) for c, place in o.row.terms),
                {q: new[c] for q, c in o.row.theta.items()},
            ),
        )
        for o in section
    ]
