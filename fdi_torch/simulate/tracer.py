"""Tracing of the plant's Python code into an expression graph: the code runs once on small tensors, and each operation
is recorded.

The physics is written once, in TankNetwork and the effects; it may contain only operations that are pointwise over
lanes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from fdi_torch.plant.network import TankNetwork
from fdi_torch.simulate.expression import Graph, Varies

_LANES = 2  # any number above 1, which distinguishes lanes from single numbers

_SAME = {"expand", "view", "detach", "clone", "alias", "lift_fresh", "contiguous", "unsqueeze", "squeeze", "reshape"}
_DIRECT = {
    "mul", "div", "neg", "abs", "sign", "sgn", "sqrt", "exp", "log", "sin", "cos", "tanh", "floor", "ceil", "trunc",
    "round", "minimum", "maximum", "where", "lt", "le", "gt", "ge", "eq", "ne",
}  # fmt: skip
_RENAMED = {
    "sgn": "sign",
    "clamp_min": "at_least",
    "clamp_max": "at_most",
    "logical_and": "and",
    "logical_or": "or",
    "logical_not": "not",
    "bitwise_and": "and",
    "bitwise_or": "or",
    "bitwise_not": "not",
    "__and__": "and",
    "__or__": "or",
}


class Tracer(TorchDispatchMode):
    """While active, records operations on tensors made by `tensor` in the graph."""

    def __init__(self, graph: Graph) -> None:
        super().__init__()
        self.graph = graph
        self._node: dict[int, int] = {}
        self._alive: list[Tensor] = []  # keeps tensors alive, so that ids remain unique

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """False, because torch would otherwise import its compiler at the first call (1.5 s), which is not used
        here.
        """
        return False

    def tensor(self, node: int) -> Tensor:
        """A tensor that represents a node: (2,) if it varies between lanes, else without dimensions."""
        shape = (_LANES,) if self.graph.nodes[node].varies & Varies.LANE else ()
        return self._track(torch.full(shape, 0.5, dtype=torch.float64, device="cpu"), node)

    def node(self, value: Any) -> int:
        """The node that a tensor or number represents."""
        if not isinstance(value, Tensor):
            return self.graph.number(float(value))
        if id(value) not in self._node:
            if value.numel() != 1:
                raise ValueError(f"expected numbers or lanes in a plant's equations, got shape {tuple(value.shape)}")
            return self.graph.number(float(value))
        return self._node[id(value)]

    def _track(self, tensor: Tensor, node: int) -> Tensor:
        self._node[id(tensor)] = node
        self._alive.append(tensor)
        return tensor

    def __torch_dispatch__(
        self, function: Any, types: Any, args: Sequence[Any] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        result = function(*args, **kwargs)
        tensors = [a for a in args if isinstance(a, Tensor)]
        if any(id(t) in self._node for t in tensors):
            self._track(result, self._record(function.overloadpacket.__name__, args, kwargs))
        return result

    def _record(self, name: str, args: Sequence[Any], kwargs: dict[str, Any]) -> int:
        name = name.removesuffix("_") if not name.startswith("__") else name
        g, node = self.graph, self.node
        if name in _SAME:
            return node(args[0])
        if name in _SPECIAL:
            return _SPECIAL[name](self, args, kwargs)
        if name in _DIRECT or name in _RENAMED:
            if kwargs.get("rounding_mode"):
                raise ValueError(f"expected plain division in a plant's equations, got {kwargs['rounding_mode']}")
            return g.apply(_RENAMED.get(name, name), *(node(a) for a in args if a is not None))
        raise ValueError(
            f"expected pointwise operations in a plant's equations, got '{name}'; write it with one of "
            f"{', '.join(sorted(_DIRECT | _SPECIAL.keys()))}, or add a row to OPERATIONS"
        )


def _clamp(t: Tracer, args: Sequence[Any], kwargs: dict[str, Any]) -> int:
    low = args[1] if len(args) > 1 else kwargs.get("min")
    high = args[2] if len(args) > 2 else kwargs.get("max")
    result = t.node(args[0])
    for operation, bound in (("maximum", low), ("minimum", high)):
        if isinstance(bound, Tensor):
            result = t.graph.apply(operation, result, t.node(bound))
        elif bound is not None:
            result = t.graph.apply({"maximum": "at_least", "minimum": "at_most"}[operation], result, t.node(bound))
    return result


def _power(t: Tracer, args: Sequence[Any], kwargs: dict[str, Any]) -> int:
    base, exponent = args[:2]
    g = t.graph
    if exponent in (2, 2.0) and not isinstance(exponent, Tensor):
        return g.apply("mul", t.node(base), t.node(base))
    if exponent == 0.5 and not isinstance(exponent, Tensor):
        return g.apply("sqrt", t.node(base))
    return g.apply("pow", t.node(base), t.node(exponent))


def _sum(t: Tracer, operation: str, args: Sequence[Any], kwargs: dict[str, Any]) -> int:
    scale = kwargs.get("alpha", 1)
    return t.graph.apply(operation, t.node(args[0]), t.graph.apply("mul", t.node(args[1]), t.node(scale)))


def _cast(t: Tracer, args: Sequence[Any], kwargs: dict[str, Any]) -> int:
    node = t.node(args[0])
    if kwargs.get("dtype") is not torch.bool and t.graph.nodes[node].boolean:
        return t.graph.apply("where", node, t.graph.literal(1.0), t.graph.literal(0.0))
    return node


def _truth(t: Tracer, operation: str, args: Sequence[Any]) -> int:
    """A product in which truth values count as 1 and 0."""
    parts = [_cast(t, (a,), {}) for a in args]
    return t.graph.apply(operation, *parts)


_SPECIAL: dict[str, Callable[[Tracer, Sequence[Any], dict[str, Any]], int]] = {
    "add": lambda t, a, k: _sum(t, "add", a, k),
    "sub": lambda t, a, k: _sum(t, "sub", a, k),
    "rsub": lambda t, a, k: t.graph.apply("sub", t.node(a[1]), t.node(a[0])),
    "mul": lambda t, a, k: _truth(t, "mul", a),
    "reciprocal": lambda t, a, k: t.graph.apply("div", t.graph.literal(1.0), t.node(a[0])),
    "rsqrt": lambda t, a, k: t.graph.apply("div", t.graph.literal(1.0), t.graph.apply("sqrt", t.node(a[0]))),
    "square": lambda t, a, k: t.graph.apply("mul", t.node(a[0]), t.node(a[0])),
    "relu": lambda t, a, k: t.graph.apply("at_least", t.node(a[0]), t.graph.literal(0.0)),
    "clamp": _clamp,
    "pow": _power,
    "_to_copy": _cast,
    "zeros_like": lambda t, a, k: t.graph.literal(0.0),
    "ones_like": lambda t, a, k: t.graph.literal(1.0),
    "full_like": lambda t, a, k: t.node(a[1]),
}


class Structure:
    """A network as the key of a cache: two are equal if all that their equations depend on is equal."""

    def __init__(self, key: tuple[object, ...], network: TankNetwork) -> None:
        self.key, self.network, self._hash = key, network, hash(key)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Structure) and self.key == other.key


def structure_of_rates(network: TankNetwork, names: Sequence[str]) -> Structure:
    """For dh/dt as a function of the state, the actuators' outputs and the parameters `names`."""
    plant = network.description
    parts = type(network), network.may_overflow, plant.gravity, plant.tanks, *plant.flow_components()
    effects = tuple((p.location, p.effect) for p in network.placements)
    return Structure((parts, effects, network.constants.names, tuple(names)), network)


def structure_of(network: TankNetwork, names: Sequence[str]) -> Structure:
    """For all equations from the input channels to the readings."""
    of_rates = structure_of_rates(network, names)
    return Structure((*of_rates.key, network.description.sensors), network)
