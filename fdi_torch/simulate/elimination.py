"""Elimination in a sparse matrix whose pattern is known: the order of its pivots, and what each of them changes.

Pivots are taken from the diagonal, those with the fewest entries beside them first (Markowitz 1957), which leaves
hardly any fill-in in a network of tanks that is nearly a tree. 1 - c df/dh needs no other pivots: water that leaves a
tank arrives in another one, so that the diagonal outweighs its column.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor

X = TypeVar("X")


@dataclass(frozen=True)
class Elimination:
    """entries: (row, column) of everything that is not zero once all is eliminated, the diagonal first.

    given: for each entry its place in the pattern, -1 for a diagonal or a fill-in that the pattern lacks.
    order: the pivots. rows: (entry, pivot) of each multiplier in the order of the work, and after it `updates`:
    (entry, entry of the pivot's row) from which the multiplier times the second is taken.
    """

    size: int
    entries: tuple[tuple[int, int], ...]
    given: tuple[int, ...]
    order: tuple[int, ...]
    rows: tuple[tuple[int, int], ...]
    updates: tuple[tuple[tuple[int, int], ...], ...]
    above: tuple[tuple[tuple[int, int], ...], ...]  # of each pivot, in the order: (entry, column) beyond the diagonal

    def factored(self, matrix: Sequence[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
        """matrix: one tensor an entry -> multipliers and the upper factor in its place, and the pivots' inverses."""
        lu, inverse = list(matrix), [torch.empty(0)] * self.size
        work = list(zip(self.rows, self.updates, strict=True))
        for pivot in self.order:
            inverse[pivot] = 1.0 / lu[pivot]
            for (entry, _), updates in (w for w in work if w[0][1] == pivot):
                lu[entry] = lu[entry] * inverse[pivot]
                for changed, beyond in updates:
                    lu[changed] = lu[changed] - lu[entry] * lu[beyond]
        return lu, inverse

    def solved(self, factors: tuple[list[Tensor], list[Tensor]], right: Sequence[Tensor]) -> list[Tensor]:
        """The solution for a right-hand side, one tensor a row."""
        (lu, inverse), x = factors, list(right)
        for entry, pivot in self.rows:
            row = self.entries[entry][0]
            x[row] = x[row] - lu[entry] * x[pivot]
        for pivot, beyond in zip(reversed(self.order), reversed(self.above), strict=True):
            for entry, column in beyond:
                x[pivot] = x[pivot] - lu[entry] * x[column]
            x[pivot] = x[pivot] * inverse[pivot]
        return x


def eliminate(size: int, pattern: Sequence[tuple[int, int]]) -> Elimination:
    """The work for a matrix of that size whose entries (row, column) besides the diagonal are those of the pattern."""
    place = {at: e for e, at in enumerate(pattern)}
    entries = {(i, i): i for i in range(size)}
    for at in pattern:
        entries.setdefault(at, len(entries))
    left, order = set(range(size)), []
    rows: list[tuple[int, int]] = []
    updates, above = [], []
    columns = _neighbours(size, entries, lambda at: at)
    lines = _neighbours(size, entries, lambda at: (at[1], at[0]))
    while left:
        pivot = min(left, key=lambda k: ((len(columns[k]) - 1) * (len(lines[k]) - 1), k))
        left.remove(pivot)
        order.append(pivot)
        beyond = sorted(columns[pivot] & left)
        below = sorted(lines[pivot] & left)
        for row in below:
            rows.append((entries[row, pivot], pivot))
            for column in beyond:
                entries.setdefault((row, column), len(entries))
                columns[row].add(column)
                lines[column].add(row)
            updates.append(tuple((entries[row, column], entries[pivot, column]) for column in beyond))
        above.append(tuple((entries[pivot, column], column) for column in beyond))
        for k in left:
            columns[k].discard(pivot)
            lines[k].discard(pivot)
    given = tuple(place.get(at, -1) for at in entries)
    return Elimination(size, tuple(entries), given, tuple(order), tuple(rows), tuple(updates), tuple(above))


def _neighbours(
    size: int, entries: dict[tuple[int, int], int], turned: Callable[[tuple[int, int]], tuple[int, int]]
) -> list[set[int]]:
    """For each row the columns of its entries; with rows and columns exchanged, for each column the rows."""
    found: list[set[int]] = [set() for _ in range(size)]
    for row, column in map(turned, entries):
        found[row].add(column)
    return found
