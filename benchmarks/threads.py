"""Wall-clock time with one thread and with two, on a machine that does nothing else."""

from __future__ import annotations

import time

import torch

from benchmarks.simulators import experiment, plant, random_faults
from fdi_torch.simulate.compiled_engine import CompiledEngine
from fdi_torch.simulate.engine import Readings

STEP, LANES, RUNS = 10.0, (1_024, 16_384, 1_000_000), 8
Row = tuple[int, float, float]


def measure(budget: float) -> list[Row]:
    """Lanes, and trajectories per second with one thread and with two. budget is not used: each takes
    RUNS turns, of which the fastest counts.
    """
    network, space = plant()
    engine = CompiledEngine(network, space, experiment(STEP))
    values = engine.readings(space.nominal())
    data = Readings(values, torch.ones_like(values))
    rows = []
    for lanes in LANES:
        theta = torch.from_numpy(random_faults(lanes))
        spent: dict[int, list[float]] = {1: [], 2: []}
        for _ in range(RUNS):
            for threads, own in spent.items():
                torch.set_num_threads(threads)
                own.append(_seconds(lambda theta=theta: engine.moments(theta, data)))
        rows.append((lanes, *(lanes / min(own) for own in spent.values())))
    torch.set_num_threads(1)
    return rows


def _seconds(run) -> float:  # type: ignore[no-untyped-def]
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def table(rows: list[Row]) -> str:
    lines = ["| lanes | one thread, trajectories/s | two threads | ratio |", "|---|---|---|---|"]
    return "\n".join(lines + [f"| {n:,} | {a:,.0f} | {b:,.0f} | {b / a:.2f} |" for n, a, b in rows])
