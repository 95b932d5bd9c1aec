"""How fast something is, in CPU seconds, which a busy machine disturbs less than those of the clock on the wall."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from statistics import median

ROUNDS = 5
SHORTEST = 0.03  # s; a thread that still runs is charged late, so that a single millisecond may read as none


def seconds_in_rounds(runs: Sequence[Callable[[], object]], budget: float = 1.0, rounds: int = ROUNDS) -> list[float]:
    """CPU seconds (all threads) of each, the median over rounds in which all take turns.

    What disturbs the machine for a while disturbs all of them, or a minority of one's turns. budget: about the seconds
    for each, after a first run that compiles.
    """
    repeats = [_repeats(run, max(budget / rounds, SHORTEST)) for run in runs]
    turns = [[_seconds(run, n) for run, n in zip(runs, repeats, strict=True)] for _ in range(rounds)]
    return [median(column) for column in zip(*turns, strict=True)]


def _repeats(run: Callable[[], object], wanted: float) -> int:
    """How often to run it at a time for that many seconds."""
    run()
    start = time.perf_counter()
    run()
    return max(1, round(wanted / max(time.perf_counter() - start, 1e-6)))


def _seconds(run: Callable[[], object], repeats: int) -> float:
    start = time.process_time()
    for _ in range(repeats):
        run()
    return max((time.process_time() - start) / repeats, 1e-9)
