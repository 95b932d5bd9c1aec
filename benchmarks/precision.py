"""Work against precision: worst and median error over random faults, and trajectories per CPU second."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from benchmarks.simulators import ADAPTIVE, FIXED, Simulator, fdi, random_faults
from benchmarks.timing import best_seconds

FAULTS = 1000
FINEST = 0.002  # s; the truth
STEPS = (10.0, 5.0, 2.0, 1.0, 0.5, 0.2, 0.1)
FINER = (0.05, 0.02, 0.01)  # ours only: the others' points lie beside ours, whatever the step
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10)
OURS = "fdi_torch, compiled"
PEERS = (OURS, "numba, by hand, blocks of lanes", "JAX lax.scan, by hand")
Row = tuple[str, str, float, float, float]


def measure(budget: float) -> list[Row]:
    theta = random_faults(FAULTS)
    truth = fdi(FINEST)(theta)
    rows: list[Row] = []
    for name in (*PEERS, *ADAPTIVE):
        make = {**FIXED, **ADAPTIVE}[name]
        for setting in TOLERANCES if name in ADAPTIVE else STEPS + FINER * (name == OURS):
            try:
                simulate = make(setting)
            except ImportError:
                break
            label = f"{setting:g} s" if name in FIXED else f"tolerance {setting:g}"
            rows.append((name, label, *_row(simulate, theta, truth, budget)))
    return rows


def _row(simulate: Simulator, theta: np.ndarray, truth: np.ndarray, budget: float) -> tuple[float, float, float]:
    """Worst and median error (cm) of a trajectory, and trajectories per CPU second."""
    error = 100.0 * np.abs(simulate(theta) - truth).max(axis=(1, 2))
    return float(error.max()), float(np.median(error)), len(theta) / best_seconds(lambda: simulate(theta), budget, 3)


def table(rows: list[Row]) -> str:
    """The last column: our rate at that worst error, on the line between our points around it, over that rate."""
    ours = sorted((math.log(w), math.log(r)) for n, _, w, _, r in rows if n == OURS)
    lines = ["| simulator | setting | worst error, cm | median error, cm | trajectories/s | ours over it |"]
    lines.append("|---|---|---|---|---|---|")
    for n, s, w, m, r in rows:
        inside = ours[0][0] <= math.log(w) <= ours[-1][0]
        ratio = math.exp(float(np.interp(math.log(w), *zip(*ours, strict=True)))) / r
        lines.append(
            f"| {n} | {s} | {w:.1e} | {m:.1e} | {r:,.0f} | {f'{ratio:.1f}' if inside else 'beyond our steps'} |"
        )
    return "\n".join(lines)


def draw(rows: list[Row], path: Path) -> None:
    """Trajectories per CPU second against the worst error, both logarithmic; up and to the left is better."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.2), layout="constrained", dpi=150)
    axes = figure.subplots()
    for name in dict.fromkeys(row[0] for row in rows):
        own = [row for row in rows if row[0] == name]
        axes.plot([row[2] for row in own], [row[4] for row in own], "o-", label=name)
    axes.set(
        xscale="log", yscale="log", xlabel="worst error over random faults, cm", ylabel="trajectories per CPU second"
    )
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    figure.savefig(path)
