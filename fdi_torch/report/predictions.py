"""What a log says of its model: optional arrays of `results.npz`, the size of residuals, and how far the run is.

The arrays are SI, with sensors in the order of `/plant/output`:

| array | shape | what it is |
|---|---|---|
| `predicted` | (T, N) | readings at the estimate, at the samples of the recording |
| `predicted_K` | (T, N) | the same for the K-th of several recordings, from 1 |
| `nominal`, `recalibrated`, `augmented`, `ceiling` | (T, N) | readings that each model of a gap diagnosis predicts |
| `holdout_time` | (S,) | clock of the hold-out in s |
| `holdout_read` | (S, N) | its readings, NaN where masked |
| `holdout_nominal`, `holdout_recalibrated`, `holdout_augmented`, `holdout_ceiling` | (S, N) | its predictions |
| `holdout_K_...`, `recording_K_...` | (S, N) | the same for the K-th of several hold-outs or recordings, from 2 |
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from fdi_torch.names import counted
from fdi_torch.report.material import Material
from fdi_torch.report.numbers import number


def predicted(material: Material, k: int) -> np.ndarray | None:
    """Predicted readings of recording k (from 0), at the estimate or with the cause of the run; None without any."""
    arrays, group, shape = material.arrays, material.groups[k], material.recordings[k].outputs.shape
    alone = ("predicted",) if len(material.groups) == 1 else ()
    for name in (f"predicted_{k + 1}", *alone, f"{group}_augmented" if group else "augmented"):
        values = arrays.get(name)
        if values is not None and values.dtype.kind == "f" and values.shape == shape:
            return values
    return None


def residuals(material: Material, k: int) -> np.ndarray | None:
    """Readings of recording k less their predictions, NaN where masked; None without predictions."""
    model, recording = predicted(material, k), material.recordings[k]
    return None if model is None else np.where(recording.mask, recording.outputs - model, np.nan)


def holdout_prefix(number: int) -> str:
    """Prefix of the arrays of the hold-out with this number (from 0)."""
    return "holdout" if number == 0 else f"holdout_{number + 1}"


@dataclass(frozen=True)
class Progress:
    """text: how far the run is. share: part of its budget that is used, 0 to 1; None if the log does not contain it."""

    text: str
    share: float | None = None


def progress_of(material: Material) -> Progress:
    """How far the run is: its last iteration, generation, trial or logged sample."""
    iterations, generations = material.of("/estimator/refine/iteration"), material.of("/estimator/de/generation")
    if iterations:
        last = iterations[-1]
        return Progress(f"refinement: iteration {last.get('iteration')}, cost {_number(last.get('cost'))}")
    if generations:
        last = generations[-1]
        evaluations, limit = last.get("evaluations"), material.about("config").get("estimate.search.evaluations", "")
        text = f"search: generation {last.get('generation')}, cost {_number(last.get('best_cost'))}"
        share = _share(evaluations, limit)
        return Progress(text if share is None else f"{text}, {evaluations} of at most {limit} simulations", share)
    trials = material.counts.get("/study/trial", 0)
    if trials:
        total = material.about("config").get("study.all_trials", "")
        share = _share(trials, total)
        return Progress(f"{counted(trials, 'trial')} done" if share is None else f"{trials} of {total} trials", share)
    if material.kind == "monitor" and material.recordings and len(material.recordings[0].time):
        return Progress(f"monitored until {number(float(material.recordings[0].time[-1]), 6)} s")
    messages = material.of("/log")
    return Progress(str(messages[-1].get("message", "")) if messages else "started")


def _share(done: Any, total: str) -> float | None:
    """The share of a number that a log states; None if it states none."""
    known = isinstance(done, int) and total.isascii() and total.isdigit() and int(total) > 0
    return min(done / int(total), 1.0) if known else None


@dataclass(frozen=True)
class SensorResidual:
    """Root mean square of residuals over all recordings but hold-outs, its SI unit, the number of readings."""

    rms: float
    unit: str
    readings: int


def sensor_residuals(material: Material) -> dict[str, SensorResidual]:
    """Residuals read - estimate of each sensor that the log has them for.

    The estimate is the run's prediction, or the observer's in a monitor.
    """
    squares: dict[tuple[str, str], list[np.ndarray]] = {}
    for k, recording in material.fitted.items():
        residual = residuals(material, k)
        for i, key in enumerate(zip(recording.output_names, recording.output_units, strict=True)):
            column = material.residuals.get(key[0]) if residual is None else residual[:, i]
            if column is not None:
                squares.setdefault(key, []).append(np.asarray(column)[np.isfinite(column)] ** 2)
    joined = {key: np.concatenate(parts) for key, parts in squares.items()}
    return {n: SensorResidual(float(np.sqrt(s.mean())), u, len(s)) for (n, u), s in joined.items() if len(s)}


def residual_size(material: Material) -> tuple[float, str, str]:
    """Root mean square of the residuals of all sensors together, its SI unit, and the name of a sensor, which chooses
    the unit shown. NaN if the log has none, or if its sensors have different units.
    """
    residuals = sensor_residuals(material)
    sensors = residuals.values()
    if len({sensor.unit for sensor in sensors}) != 1:
        return math.nan, "", ""
    readings = sum(sensor.readings for sensor in sensors)
    size = math.sqrt(sum(s.readings * s.rms**2 for s in sensors) / readings)
    return size, next(iter(sensors)).unit, next(iter(residuals))


def _number(value: object) -> str:
    return number(float(value), 4) if isinstance(value, int | float) else "unknown"
