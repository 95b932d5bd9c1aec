"""How fast something is: the best of several runs, in CPU seconds, which a busy machine disturbs least."""

from __future__ import annotations

import time
from collections.abc import Callable


def best_seconds(run: Callable[[], object], budget: float = 1.0, at_most: int = 50) -> float:
    """CPU seconds (all threads) of the fastest run within about `budget` s, after a first one that compiles."""
    run()
    best, end, runs = float("inf"), time.perf_counter() + budget, 0
    while runs < 2 or (time.perf_counter() < end and runs < at_most):
        start = time.process_time()
        run()
        best, runs = min(best, time.process_time() - start), runs + 1
    return max(best, 1e-9)
