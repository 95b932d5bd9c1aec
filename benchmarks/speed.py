"""Trajectories per CPU second by the number of lanes, 1000 s in 10 s RK4 steps, float64, of two plants.

Three tanks read every 100 s, and the same with eight effects with memory, read every 10 s.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from benchmarks import memory
from benchmarks.simulators import ADAPTIVE, FIXED, Simulator, random_faults
from benchmarks.timing import seconds_in_rounds

LANES = (64, 1024, 16384)
STEP, TOLERANCE = 10.0, 1e-6
OURS, BY_HAND = "fdi_torch, compiled", "numba, by hand, blocks of lanes"
Rows = dict[str, list[float]]


def measure(budget: float) -> dict[str, Rows]:
    """Rows of each plant's table; a fixed-step peer must get the same numbers as we do."""
    three = {name: (lambda make=make: make(STEP)) for name, make in FIXED.items()}
    three |= {name: (lambda make=make: make(TOLERANCE)) for name, make in ADAPTIVE.items()}
    return {
        "three tanks": _plant(three, random_faults(max(LANES)), budget),
        "three tanks, eight effects with memory, 13 parameters": _plant(
            memory.SIMULATORS, memory.random_theta(max(LANES)), budget
        ),
    }


def _plant(simulators: dict[str, Callable[[], Simulator]], theta: np.ndarray, budget: float) -> Rows:
    truth = simulators[OURS]()(theta[:64])
    able: dict[str, Simulator] = {}
    for name, make in simulators.items():
        try:
            simulate = make()
            found = simulate(theta[:64])
        except ImportError:
            continue
        if name not in ADAPTIVE:
            error = np.abs(found - truth).max()
            assert error < (1e-3 if "float32" in name else 1e-9), f"{name}: levels differ by {error:.1e} m"
        able[name] = simulate
    columns = [_rates(able, theta[:lanes], budget) for lanes in LANES]
    return {name: [column[name] for column in columns] for name in able}


def _rates(simulators: dict[str, Simulator], theta: np.ndarray, budget: float) -> dict[str, float]:
    """Trajectories per CPU second of each; those that take one after the other are given some of the lanes only."""
    parts = {n: theta[:64] if "SciPy" in n else theta[:1024] if "diffrax" in n else theta for n in simulators}
    runs = [lambda run=run, part=parts[name]: run(part) for name, run in simulators.items()]
    seconds = seconds_in_rounds(runs, budget)
    return {name: len(parts[name]) / spent for name, spent in zip(simulators, seconds, strict=True)}


def table(plants: dict[str, Rows]) -> str:
    return "\n\n".join(f"**{plant}**\n\n{_table(rows)}" for plant, rows in plants.items())


def _table(rows: Rows) -> str:
    """The last two lines: against what others' users run, and against our own kernel's layout written by hand."""
    lines = ["| simulator | " + " | ".join(f"{n} lanes" for n in LANES) + " |", "|---|" + "---|" * len(LANES)]
    lines += [f"| {name} | " + " | ".join(f"{r:,.0f}" for r in row) + " |" for name, row in rows.items()]
    peers = [row for name, row in rows.items() if not name.startswith("fdi_torch") and name != BY_HAND]
    lines.append(_ratios("compiled over the best peer", rows[OURS], peers))
    if BY_HAND in rows:
        lines.append(_ratios("compiled over its own layout by hand", rows[OURS], [rows[BY_HAND]]))
    return "\n".join(lines)


def _ratios(title: str, ours: list[float], peers: list[list[float]]) -> str:
    best = [max(column) for column in zip(*peers, strict=True)]
    return f"| **{title}** | " + " | ".join(f"{a / b:.1f}" for a, b in zip(ours, best, strict=True)) + " |"
