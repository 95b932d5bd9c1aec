"""Nodes that are needed only where a condition holds: expensive branches of a `where` that most lanes never take.

A level rarely exceeds its rim, so the square roots and quotients of the weir are skipped for a vector of lanes in which
none does. How lanes share vectors affects what is computed but no result: each lane selects by its own condition.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

from fdi_torch.simulate.expression import Graph
from fdi_torch.simulate.step_invariants import EXPENSIVE


def guarded(graph: Graph, order: Sequence[int], outputs: Collection[int]) -> dict[int, int]:
    """Nodes of `order` that matter only where a condition holds -> the node of that condition.

    Such a node is used only in the first branch of `where`s with that condition, or by other such nodes, and is no
    output. Conditions that would save no expensive operation are left out.
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
