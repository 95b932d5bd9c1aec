"""The pointwise operations that a plant's equations may use: their form in torch and C, and their derivatives.

Each operation is one row of `OPERATIONS`, which tracing, execution, differentiation and code generation all use.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from fdi_torch.simulate.expression import Graph


Partials = Callable[["Graph", int, tuple[int, ...]], tuple[int | None, ...]]


@dataclass(frozen=True)
class Operation:
    """torch: the function on tensors. c: the C expression. partials: d out / d argument, None where it is zero.

    boolean: whether the result is a truth value.
    """

    torch: Callable[..., Tensor]
    c: str
    partials: Partials | None = None
    boolean: bool = False


def _where(condition: Tensor, yes: Tensor, no: Tensor) -> Tensor:
    return torch.where(condition, yes, no)


def _comparison(function: Callable[..., Tensor], name: str) -> Operation:
    return Operation(function, f"{name}({{0}}, {{1}})", boolean=True)


def _choose(g: Graph, condition: int, yes: float, no: float) -> int:
    return g.apply("where", condition, g.literal(yes), g.literal(no))


def _flat(g: Graph, out: int, a: tuple[int, ...]) -> tuple[int | None, ...]:
    return tuple(None for _ in a)


def _extreme(compare: str) -> Partials:
    def partials(g: Graph, out: int, a: tuple[int, ...]) -> tuple[int | None, ...]:
        x, y = a
        tie = g.apply("eq", x, y)
        half = g.literal(0.5)
        first = g.apply("where", tie, half, _choose(g, g.apply(compare, x, y), 1.0, 0.0))
        return first, g.apply("sub", g.literal(1.0), first)

    return partials


def _power(g: Graph, out: int, a: tuple[int, ...]) -> tuple[int | None, ...]:
    x, n = a
    below = g.apply("pow", x, g.apply("sub", n, g.literal(1.0)))
    by_exponent = None if g.value(n) is not None else g.apply("mul", out, g.apply("log", x))
    return g.apply("mul", n, below), by_exponent


def _tanh(g: Graph, out: int, a: tuple[int, ...]) -> tuple[int | None, ...]:
    return (g.apply("sub", g.literal(1.0), g.apply("mul", out, out)),)


def _inverse_fourth_root(g: Graph, out: int, a: tuple[int, ...]) -> tuple[int | None, ...]:
    """-1/4 s^(-5/4), without a division."""
    square = g.apply("mul", out, out)
    return (g.apply("mul", g.literal(-0.25), g.apply("mul", out, g.apply("mul", square, square))),)


def _divide(g: Graph, out: int, a: tuple[int, ...]) -> tuple[int | None, ...]:
    inverse = g.apply("div", g.literal(1.0), a[1])
    return inverse, g.apply("neg", g.apply("mul", out, inverse))


OPERATIONS: dict[str, Operation] = {
    "add": Operation(torch.add, "{0} + {1}", lambda g, out, a: (g.literal(1.0), g.literal(1.0))),
    "sub": Operation(torch.sub, "{0} - {1}", lambda g, out, a: (g.literal(1.0), g.literal(-1.0))),
    "mul": Operation(torch.mul, "{0} * {1}", lambda g, out, a: (a[1], a[0])),
    "div": Operation(torch.div, "{0} / {1}", _divide),
    "neg": Operation(torch.neg, "-{0}", lambda g, out, a: (g.literal(-1.0),)),
    "abs": Operation(torch.abs, "FABS({0})", lambda g, out, a: (g.apply("sign", a[0]),)),
    "sign": Operation(torch.sign, "SIGN({0})", _flat),
    "sqrt": Operation(torch.sqrt, "SQRT({0})", lambda g, out, a: (g.apply("div", g.literal(0.5), out),)),
    # not an operation of torch: occurs in the regularised square root x / (x^2 + w^2)^(1/4)
    "inverse_fourth_root": Operation(
        lambda s: 1.0 / torch.sqrt(torch.sqrt(s)), "INVERSE_FOURTH_ROOT({0})", _inverse_fourth_root
    ),
    "exp": Operation(torch.exp, "EXP({0})", lambda g, out, a: (out,)),
    "log": Operation(torch.log, "LOG({0})", lambda g, out, a: (g.apply("div", g.literal(1.0), a[0]),)),
    "pow": Operation(torch.pow, "POW({0}, {1})", _power),
    "sin": Operation(torch.sin, "SIN({0})", lambda g, out, a: (g.apply("cos", a[0]),)),
    "cos": Operation(torch.cos, "COS({0})", lambda g, out, a: (g.apply("neg", g.apply("sin", a[0])),)),
    "tanh": Operation(torch.tanh, "TANH({0})", _tanh),
    "floor": Operation(torch.floor, "FLOOR({0})", _flat),
    "ceil": Operation(torch.ceil, "CEIL({0})", _flat),
    "trunc": Operation(torch.trunc, "TRUNC({0})", _flat),
    "round": Operation(torch.round, "ROUND({0})", _flat),
    "minimum": Operation(torch.minimum, "MINIMUM({0}, {1})", _extreme("lt")),
    "maximum": Operation(torch.maximum, "MAXIMUM({0}, {1})", _extreme("gt")),
    # one-sided clamp: unlike minimum and maximum, torch passes the full slope for a value on the bound
    "at_least": Operation(
        torch.clamp_min, "AT_LEAST({0}, {1})", lambda g, out, a: (_choose(g, g.apply("ge", *a), 1.0, 0.0), None)
    ),
    "at_most": Operation(
        torch.clamp_max, "AT_MOST({0}, {1})", lambda g, out, a: (_choose(g, g.apply("le", *a), 1.0, 0.0), None)
    ),
    "where": Operation(
        _where, "WHERE({0}, {1}, {2})", lambda g, out, a: (None, _choose(g, a[0], 1.0, 0.0), _choose(g, a[0], 0.0, 1.0))
    ),
    "lt": _comparison(torch.lt, "LESS"),
    "le": _comparison(torch.le, "AT_MOST_AS"),
    "gt": _comparison(torch.gt, "MORE"),
    "ge": _comparison(torch.ge, "AT_LEAST_AS"),
    "eq": _comparison(torch.eq, "EQUAL"),
    "ne": _comparison(torch.ne, "DIFFERENT"),
    "and": Operation(torch.logical_and, "BOTH({0}, {1})", boolean=True),
    "or": Operation(torch.logical_or, "EITHER({0}, {1})", boolean=True),
    "not": Operation(torch.logical_not, "NOT({0})", boolean=True),
}

FOLDED: dict[str, Callable[..., float]] = {
    "add": lambda x, y: x + y,
    "sub": lambda x, y: x - y,
    "mul": lambda x, y: x * y,
    "neg": lambda x: -x,
    "sqrt": lambda x: math.sqrt(x) if x >= 0 else math.nan,
    "at_least": max,
    "at_most": min,
}
