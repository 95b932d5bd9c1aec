"""What has to be computed only where a condition holds: the dear side of a `where` that most lanes never take.

A level rarely stands above its rim; the weir's roots and quotients are skipped for a vector of lanes none of which
does. Which lanes share a vector changes what is computed, never a result: each lane chooses by its own condition.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

from fdi_torch.simulate.expression import Graph
from fdi_torch.simulate.steady import DEAR


def guarded(graph: Graph, order: Sequence[int], outputs: Collection[int]) -> dict[int, int]:
    """Nodes of `order` that matter only where a condition holds, and the node of that condition.

    Such a node is used in the first branch of `where`s of that condition only, or by other such nodes; it is no output.
    What would save no dear operation is left out.
    """
    conditions: dict[int, set[int | None]] = {i: {None} for i in outputs}
    owner: dict[int, int] = {}
    for i in reversed(order):
        found = conditions.get(i, {None})
        only = next(iter(found)) if len(found) == 1 else None
        if only is not None:
            owner[i] = only
        node = graph.nodes[i]
        first = node.arguments[1:2] if node.operation == "where" and only is None else ()
        for place, argument in enumerate(node.arguments):
            rare = argument in first and place == 1 and node.arguments.count(argument) == 1
            conditions.setdefault(argument, set()).add(node.arguments[0] if rare else only)
    worth = {owner[i] for i in owner if graph.nodes[i].operation in DEAR}
    return {i: c for i, c in owner.items() if c in worth}
