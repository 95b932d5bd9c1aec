"""Work against precision: worst and median error over random faults, and trajectories per CPU second."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from benchmarks.simulators import ADAPTIVE, FIXED, Simulator, fdi, fdi_own_steps, random_faults, scipy_lsoda
from benchmarks.timing import seconds_in_rounds

FAULTS = 1000
TRUTH, TRUTH_SHARP = 1e-12, 1e-3  # SciPy's LSODA at that tolerance, on equations as sharp as for steps of 1 ms
STEPS = (10.0, 5.0, 2.0, 1.0, 0.5, 0.2, 0.1)
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10)
OURS = {
    "fdi_torch, compiled": (fdi, STEPS),
    "fdi_torch, compiled, own steps": (fdi_own_steps, (1e-4, 3e-5, 1e-5, 3e-6, 1e-6, 1e-7, 1e-8, 1e-9)),
}
PEERS = {name: (FIXED[name], STEPS) for name in ("numba, by hand, blocks of lanes", "JAX lax.scan, by hand")}
PEERS |= {name: (make, TOLERANCES) for name, make in ADAPTIVE.items()}
Row = tuple[str, str, float, float, float]


def measure(budget: float) -> list[Row]:
    """Who, setting, worst and median error (cm) of a trajectory, and trajectories per CPU second."""
    theta = random_faults(FAULTS)
    truth = scipy_lsoda(TRUTH, TRUTH_SHARP)(theta)
    able: list[tuple[str, str, Simulator]] = []
    for name, (make, settings) in {**OURS, **PEERS}.items():
        for setting in settings:
            try:
                simulate = make(setting)
            except ImportError:
                break
            able.append((name, f"{setting:g} s" if settings is STEPS else f"tolerance {setting:g}", simulate))
    errors = [100.0 * np.abs(simulate(theta) - truth).max(axis=(1, 2)) for _, _, simulate in able]
    spent = seconds_in_rounds([lambda simulate=simulate: simulate(theta) for _, _, simulate in able], budget, 3)
    return [
        (name, label, float(error.max()), float(np.median(error)), len(theta) / seconds)
        for (name, label, _), error, seconds in zip(able, errors, spent, strict=True)
    ]


def table(rows: list[Row]) -> str:
    """The last column: our rate at that worst error over that rate.

    Ours: on the line between our points around it, of the two lines the higher one.
    """
    ours = [sorted((math.log(w), math.log(r)) for n, _, w, _, r in rows if n == name) for name in OURS]
    lines = ["| simulator | setting | worst error, cm | median error, cm | trajectories/s | ours over it |"]
    lines.append("|---|---|---|---|---|---|")
    for n, s, w, m, r in rows:
        around = [line for line in ours if line[0][0] <= math.log(w) <= line[-1][0]]
        best = max((float(np.interp(math.log(w), *zip(*line, strict=True))) for line in around), default=math.nan)
        ratio = f"{math.exp(best) / r:.1f}" if around else "beyond our points"
        lines.append(f"| {n} | {s} | {w:.1e} | {m:.1e} | {r:,.0f} | {'' if n in OURS else ratio} |")
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
