"""Nodes that vary between lanes and with the length of a step only, and are recomputed only when that length changes.

An example is a lag's exp(-dt / tau) in an experiment with equal steps.
"""

from __future__ import annotations

from fdi_torch.simulate.expression import Graph, Node, Varies

EXPENSIVE = frozenset({"sqrt", "inverse_fourth_root", "div", "exp", "log", "pow", "sin", "cos", "tanh"})


def step_invariant_nodes(graph: Graph) -> frozenset[int]:
    """The nodes that are worth storing from step to step, because they depend on an expensive operation."""
    steady: set[int] = set()
    expensive: set[int] = set()
    for i, node in enumerate(graph.nodes):
        if node.operation in EXPENSIVE or any(a in expensive for a in node.arguments):
            expensive.add(i)
        if _is_steady(node) if node.operation in ("input", "literal") else all(a in steady for a in node.arguments):
            steady.add(i)
    return frozenset(i for i in steady & expensive if graph.nodes[i].varies == Varies.BOTH)


def _is_steady(node: Node) -> bool:
    return not node.varies & Varies.STEP or (node.kind == "clock" and node.index == 1)
