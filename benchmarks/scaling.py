"""Costs of many lanes without keeping a trajectory, with sensitivities, and of a plant whose effects have memory."""

from __future__ import annotations

import resource

import torch

from benchmarks import memory
from benchmarks.simulators import experiment, plant
from benchmarks.timing import seconds_in_rounds
from fdi_torch.simulate.compiled_engine import CompiledEngine
from fdi_torch.simulate.engine import Readings

STEP = 10.0
LANES = {"moments": (1_000, 10_000, 100_000, 1_000_000), "gram": (1_000, 10_000, 100_000)}
Row = tuple[str, str, int, float, float]


def measure(budget: float) -> list[Row]:
    """Plant, what is computed, lanes, trajectories per CPU second, peak memory of the process in MiB."""
    rows: list[Row] = []
    plants = {
        "three tanks": (plant(), experiment(STEP)),
        "three tanks, eight effects with memory": (memory.plant(), memory.experiment()),
    }
    for name, ((network, space), when) in plants.items():
        engine = CompiledEngine(network, space, when)
        values = engine.readings(space.nominal())
        data = Readings(values, torch.ones_like(values))
        for what, run in {"moments": engine.moments, "gram": engine.gram}.items():
            for lanes in LANES[what]:
                theta = space.nominal().expand(lanes, -1).contiguous()
                (seconds,) = seconds_in_rounds([lambda run=run, theta=theta, data=data: run(theta, data)], budget, 3)
                peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
                rows.append((f"{name}, {len(space)} parameters", what, lanes, lanes / seconds, peak))
    return rows


def table(rows: list[Row]) -> str:
    """The last column is 10 where time is linear in lanes."""
    lines = ["| plant | sums | lanes | trajectories/s | peak memory, MiB | time over a tenth of the lanes' |"]
    lines.append("|---|---|---|---|---|---|")
    before = {(p, w, 10 * n): n / r for p, w, n, r, _ in rows}
    for p, w, n, r, m in rows:
        ratio = f"{n / r / before[p, w, n]:.1f}" if (p, w, n) in before else ""
        lines.append(f"| {p} | {w} | {n:,} | {r:,.0f} | {m:,.0f} | {ratio} |")
    return "\n".join(lines)
