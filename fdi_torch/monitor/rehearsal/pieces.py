"""A rehearsal in pieces of seconds to a minute, each computed by itself from its own seed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch

Numbers = Mapping[str, float | list[float] | list[str]]


@dataclass(frozen=True)
class Piece:
    """group: the row of a table that it belongs to, beginning with the rehearsal's name. compute: what it finds."""

    group: str
    compute: Callable[[], Numbers]


@dataclass(frozen=True)
class Shown:
    """A table: its title, its header and its rows of words; said: what it comes to, for a headline."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    said: str = ""


def seeded(*numbers: int) -> torch.Generator:
    """A generator of its own for each row of numbers."""
    seed = 0
    for number in numbers:
        seed = (1_000_003 * seed + number + 1) % 2**62
    return torch.Generator().manual_seed(seed)


def quantiles(values: list[float], shares: tuple[float, ...]) -> list[float]:
    """Order statistics; infinite values are the largest."""
    order = sorted(values)
    return [order[min(int(share * len(order)), len(order) - 1)] for share in shares] if order else [float("nan")]
