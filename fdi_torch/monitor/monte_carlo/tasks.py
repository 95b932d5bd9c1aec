"""Tasks of a Monte Carlo validation, each of seconds to a minute and with its own seed, and their result tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch

Numbers = Mapping[str, float | list[float] | list[str]]


@dataclass(frozen=True)
class Task:
    """group: plan and table row to which the numbers belong. compute: carries the task out."""

    group: str
    compute: Callable[[], Numbers]


@dataclass(frozen=True)
class ResultTable:
    """A table of texts. summary: its main result in one sentence, for a headline."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    summary: str = ""


def seeded_generator(*numbers: int) -> torch.Generator:
    """A random generator that is determined by the numbers."""
    seed = 0
    for number in numbers:
        seed = (1_000_003 * seed + number + 1) % 2**62
    return torch.Generator().manual_seed(seed)


def quantiles(values: list[float], shares: tuple[float, ...]) -> list[float]:
    """Empirical quantiles (order statistics); infinite values count as the largest."""
    order = sorted(values)
    return [order[min(int(share * len(order)), len(order) - 1)] for share in shares] if order else [float("nan")]
