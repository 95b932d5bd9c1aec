"""Logs to make pages of: small runs of every kind, with names that try to break the page."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from fdi_torch.logbook import RunLog, read_run
from fdi_torch.report.material import Material, gather

FIXED: dict[str, Any] = {
    "env": {"python": "3.11"},
    "git": {"commit": "0" * 40, "changed": "no"},
    "seeds": {"seed": 7},
    "data": [{"path": "rig.csv", "sha256": "ab" * 32}],
}
NASTY = '<script>alert("1")</script>'


def write_train(path: Path, name: str = "T1.leak.size", predicted: bool = True) -> Path:
    """A diagnosis of two parameters; the first is called `name`."""
    rng = np.random.default_rng(0)
    time = np.arange(1000.0)
    clean = np.stack([0.3 + 0.1 * np.exp(-time / 300), 0.2 + 0.05 * np.exp(-time / 200)], 1)
    read = clean + 1e-3 * rng.standard_normal(clean.shape)
    inputs = np.stack([5e-5 + 1e-5 * (time % 200 > 100), np.full(1000, 4e-5)], 1)
    with RunLog(path, "train", config_text="plant: three_tank\n", **FIXED) as log:
        log.recording(time, inputs, read, ("Q1", "Q2"), ("h1", "h2"), ("m^3/s",) * 2, ("m",) * 2)
        log.sample("/plant/truth", 0.0, {name: 0.3, "P13.openness.size": 0.6})
        for g in range(20):
            log.generation(g, 2.0 * math.exp(-g), {name: 0.3 + 0.1 / (g + 1)}, mean_cost=3.0, evaluations=50 * g)
        for i in range(5):
            log.iteration(i, 1.0 / (i + 1), {name: 0.3})
        names, covariance = [name, "P13.openness.size"], np.array([[4e-6, -3e-6], [-3e-6, 9e-6]])
        log.estimate(names, [0.3004, 0.599], [2e-3, 3e-3], covariance, "converged", units=["1", "1"])
        location, _, effect = name.partition(".")
        log.fault(effect, location, True, size=0.3004, size_std=2e-3, unit="1", flow=3e-5, hole_diameter=4.8e-3)
        log.fault("openness.size", "P13", False, size=0.599, size_std=3e-3, unit="1")
        log.say("converged")
        if predicted:
            log.result_arrays(predicted=clean)
    return path


def material_of(path: Path, plant: Any = None) -> Material:
    return gather(read_run(path, salvage=True), plant)
