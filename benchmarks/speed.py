"""Trajectories per CPU second: three tanks, 1000 s in 10 s RK4 steps, float64, by the number of lanes."""

from __future__ import annotations

import numpy as np

from benchmarks.simulators import ADAPTIVE, FIXED, random_faults
from benchmarks.timing import best_seconds

LANES = (64, 1024, 16384)
STEP, TOLERANCE = 10.0, 1e-6
OURS, BY_HAND = "fdi_torch, compiled", "numba, by hand, blocks of lanes"


def measure(budget: float) -> dict[str, list[float]]:
    """Rows of the table; a fixed-step peer must get the same levels as we do."""
    theta = random_faults(max(LANES))
    truth = FIXED[OURS](STEP)(theta[:64])
    rows: dict[str, list[float]] = {}
    for name, make in {**FIXED, **ADAPTIVE}.items():
        try:
            simulate = make(STEP if name in FIXED else TOLERANCE)
        except ImportError:
            continue
        if name in FIXED:
            error = np.abs(simulate(theta[:64]) - truth).max()
            assert error < (1e-3 if "float32" in name else 1e-9), f"{name}: levels differ by {error:.1e} m"
        rows[name] = [_rate(name, simulate, theta[:lanes], budget) for lanes in LANES]
    return rows


def _rate(name, simulate, theta, budget: float) -> float:  # type: ignore[no-untyped-def]
    part = theta[:64] if "SciPy" in name else theta[:1024] if "diffrax" in name else theta
    return len(part) / best_seconds(lambda: simulate(part), budget)


def table(rows: dict[str, list[float]]) -> str:
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
