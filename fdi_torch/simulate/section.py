"""A section of a program: nodes that are computed together, the places of their values, and their changes with
theta.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

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
