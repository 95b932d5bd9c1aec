"""A section of a program: nodes to compute together, where their values go, and how these change with theta."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

Place = tuple[str, int]


@dataclass(frozen=True)
class Row:
    """One output's change: sum of coefficient x change of an input, plus a coefficient for each column of theta."""

    terms: tuple[tuple[int, Place], ...] = ()
    theta: Mapping[int, int] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.terms or self.theta)


@dataclass(frozen=True)
class Output:
    """Where a result goes, the node that computes it, and how it changes."""

    place: Place
    node: int
    row: Row = Row()


Section = tuple[Output, ...]
