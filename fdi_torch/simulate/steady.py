"""What changes between lanes and with the length of a step only: computed anew only when that length changes.

A lag's exp(-dt / tau) is the same for every step of a regular experiment.
"""

from __future__ import annotations

from fdi_torch.simulate.expression import Graph, Node, Varies

DEAR = frozenset({"sqrt", "inverse_fourth_root", "div", "exp", "log", "pow", "sin", "cos", "tanh"})


def steady_nodes(graph: Graph) -> frozenset[int]:
    """The nodes that are worth keeping from step to step: some dear operation stands behind each."""
    steady: set[int] = set()
    dear: set[int] = set()
    for i, node in enumerate(graph.nodes):
        if node.operation in DEAR or any(a in dear for a in node.arguments):
            dear.add(i)
        if _is_steady(node) if node.operation in ("input", "literal") else all(a in steady for a in node.arguments):
            steady.add(i)
    return frozenset(i for i in steady & dear if graph.nodes[i].varies == Varies.BOTH)


def _is_steady(node: Node) -> bool:
    return not node.varies & Varies.STEP or (node.kind == "clock" and node.index == 1)
