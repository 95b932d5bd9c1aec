"""Progress of a run as its log tells it, and the size of its residuals."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fdi_torch.report.material import Material
from fdi_torch.report.numbers import number
from fdi_torch.report.predictions import predicted


@dataclass(frozen=True)
class Progress:
    """text: how far the run is. share: part of its budget that is used, 0 to 1; None if the log does not tell."""

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
        if isinstance(evaluations, int) and limit.isascii() and limit.isdigit() and int(limit) > 0:
            return Progress(f"{text}, {evaluations} of at most {limit} simulations", min(evaluations / int(limit), 1.0))
        return Progress(text)
    trials = material.counts.get("/study/trial", 0)
    if trials:
        return Progress(f"{trials} trial{'s' if trials != 1 else ''} done")
    if material.kind == "monitor" and material.recordings and len(material.recordings[0].time):
        return Progress(f"monitored until {number(float(material.recordings[0].time[-1]), 6)} s")
    said = material.of("/log")
    return Progress(str(said[-1].get("message", "")) if said else "started")


def residual_size(material: Material) -> tuple[float, str]:
    """Root mean square of read - estimate over all sensors and recordings, and its SI unit.

    The estimate is the run's prediction, or the observer's in a monitor. NaN if the log has none, or if its sensors
    have different units.
    """
    squares: list[np.ndarray] = []
    units: set[str] = set()
    for k, (group, recording) in enumerate(zip(material.groups, material.recordings, strict=True)):
        shape = recording.outputs.shape
        model = predicted(material.arrays, k, len(material.groups) > 1, shape, group)
        if model is not None:
            squares.append(np.where(recording.mask, recording.outputs - model, np.nan).ravel() ** 2)
            units.update(recording.output_units)
        elif material.residuals:
            columns = [(n, u) for n, u in zip(recording.output_names, recording.output_units, strict=True)]
            squares += [material.residuals[name] ** 2 for name, _ in columns if name in material.residuals]
            units.update(unit for _, unit in columns)
    values = np.concatenate(squares) if squares else np.zeros(0)
    values = values[np.isfinite(values)]
    if not len(values) or len(units) != 1:
        return math.nan, ""
    return float(np.sqrt(values.mean())), units.pop()


def _number(value: object) -> str:
    return number(float(value), 4) if isinstance(value, int | float) else "unknown"
