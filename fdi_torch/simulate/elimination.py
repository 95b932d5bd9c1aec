"""Sparse Gaussian elimination with a fixed pattern: the order of the pivots and the operations of each.

Pivots are on the diagonal, those with the fewest other entries first (Markowitz, 1957), which causes hardly any fill-in
in a network of tanks that is nearly a tree. 1 - c df/dh needs no other pivots: the flow out of one tank enters another
tank, so that the matrix is diagonally dominant by columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Elimination:
    """The operations of the elimination.

    entries: (row, column) of every entry that becomes nonzero, the diagonal first. given: the index of each entry in
    the pattern, -1 for a diagonal entry or fill-in that the pattern lacks. order: the pivots. rows: (entry, pivot) of
    each multiplier in order of computation; updates: for each multiplier, the pairs (entry, entry of the pivot's row)
    from which the multiplier times the second is subtracted. above: for each pivot in order, (entry, column) right of
    the diagonal.
    """

    entries: tuple[tuple[int, int], ...]
    given: tuple[int, ...]
    order: tuple[int, ...]
    rows: tuple[tuple[int, int], ...]
    updates: tuple[tuple[tuple[int, int], ...], ...]
    above: tuple[tuple[tuple[int, int], ...], ...]


def eliminate(size: int, pattern: Sequence[tuple[int, int]]) -> Elimination:
    """The elimination of a matrix of that size with off-diagonal entries (row, column) at `pattern`."""
    index = {at: e for e, at in enumerate(pattern)}
    entries = {(i, i): i for i in range(size)}
    for at in pattern:
        entries.setdefault(at, len(entries))
    remaining, order = set(range(size)), []
    rows: list[tuple[int, int]] = []
    updates, above = [], []
    columns: list[set[int]] = [set() for _ in range(size)]
    rows_of_column: list[set[int]] = [set() for _ in range(size)]
    for row, column in entries:
        columns[row].add(column)
        rows_of_column[column].add(row)
    while remaining:
        pivot = min(remaining, key=lambda k: ((len(columns[k]) - 1) * (len(rows_of_column[k]) - 1), k))
        remaining.remove(pivot)
        order.append(pivot)
        beyond = sorted(columns[pivot] & remaining)
        below = sorted(rows_of_column[pivot] & remaining)
        for row in below:
            rows.append((entries[row, pivot], pivot))
            for column in beyond:
                entries.setdefault((row, column), len(entries))
                columns[row].add(column)
                rows_of_column[column].add(row)
            updates.append(tuple((entries[row, column], entries[pivot, column]) for column in beyond))
        above.append(tuple((entries[pivot, column], column) for column in beyond))
        for k in remaining:
            columns[k].discard(pivot)
            rows_of_column[k].discard(pivot)
    given = tuple(index.get(at, -1) for at in entries)
    return Elimination(tuple(entries), given, tuple(order), tuple(rows), tuple(updates), tuple(above))
