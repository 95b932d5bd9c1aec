"""Intervals of the parameters of the built-in example, and profiles of a ridge: `python -m benchmarks.uncertainty`.

Prints the table and draws the picture of docs/explanation/uncertainty.md; seed 1, as in the run file.
"""

from __future__ import annotations

import time
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt

import fdi_torch
from fdi_torch.jobs.train import TrainResult

DRAWS = 4000
PICTURE = Path(__file__).parents[1] / "docs/pictures/uncertainty.png"
FASTER = "estimate.step.refine=1 s"
RIDGE = (
    "estimate.parameters=[P13.plugging, P13.discharge_coefficient]",
    "estimate.calibrate=[]",
    "simulate.faults={P13.plugging: 0.3}",
)


def rows(name: str, *overrides: str) -> TrainResult:
    """Fit, profile and draw; print one row per parameter and the CPU seconds."""
    with TemporaryDirectory() as folder:
        began = time.process_time()
        done = fdi_torch.train(fdi_torch.load_run(None, [*overrides, f"output.folder={folder}"]))
        fitted = time.process_time()
        profiles = done.profile()
        profiled = time.process_time()
        draws = done.sample(DRAWS, seed=1)
        drawn = time.process_time()
    estimate = done.result.estimate
    intervals = (estimate.interval(), draws.interval())
    for i, profile in enumerate(profiles):
        (a, b), (c, d) = ((float(low[i]), float(high[i])) for low, high in intervals)
        text = " | ".join(f"{x:.4f} to {y:.4f}" for x, y in ((a, b), (profile.low, profile.high), (c, d)))
        print(f"| {name}: {profile.name} | {float(estimate.value[i]):.4f} | {text} |", flush=True)
    spent = f"{fitted - began:.1f}, {profiled - fitted:.1f}, {drawn - profiled:.1f}"
    print(f"{name}: fit, profiles, draws {spent} CPU s; {draws.headline}; {[p.headline for p in profiles]}", flush=True)
    figure, panes = plt.subplots(1, len(profiles), figsize=(3.0 * len(profiles), 2.6), layout="constrained")
    for i, (pane, profile) in enumerate(zip(panes, profiles, strict=True)):
        pane.hist(draws.values[..., i].flatten(), 40, density=True, color="#c9d6df", label="draws")
        curve = pane.twinx()
        curve.plot(profile.x, profile.ratio, "k.-", label="profile")
        curve.axhline(profile.threshold, color="k", linewidth=0.5, linestyle=":")
        curve.set_ylim(0.0, 1.6 * profile.threshold)
        curve.set_ylabel("likelihood ratio" if i == len(profiles) - 1 else "")
        pane.set(xlabel=profile.name, yticks=[])
    figure.savefig(PICTURE, dpi=110)
    plt.close(figure)
    return done


if __name__ == "__main__":
    rows("example", FASTER)
    with TemporaryDirectory() as where:
        ridge = fdi_torch.train(fdi_torch.load_run(None, [FASTER, *RIDGE, f"output.folder={where}"]))
    print(ridge, *(profile.headline for profile in ridge.profile()), sep="\n")
