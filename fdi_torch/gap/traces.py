"""What each model predicts, as arrays for the log and the page: on the recording and on every hold-out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from fdi_torch.gap.closure import HeldOut, Model, free_run
from fdi_torch.gap.finding import Finding
from fdi_torch.gap.subject import Subject

KEPT = ("nominal", "recalibrated", "augmented", "ceiling")


def traces(found: Finding, held: Sequence[HeldOut]) -> dict[str, Tensor]:
    """Arrays by name, SI, sensors in the order of the recording; hold-outs from the second on carry their number."""
    fitter = found.fitter
    arrays: dict[str, Tensor] = {}
    for k, rows in enumerate(fitter.subject.rows):
        subject = fitter.subject.alone(k)
        predicted = {
            "nominal": free_run(subject, fitter.noise, Model())[0],
            "recalibrated": found.null.near.readings[0, rows],
            "augmented": found.best.near.readings[0, rows],
        }
        prefix = "" if k == 0 else f"recording_{k + 1}_"
        arrays |= {f"{prefix}{name}": _as_recorded(subject, values) for name, values in predicted.items()}
    for k, one in enumerate(held):
        prefix = "holdout" if k == 0 else f"holdout_{k + 1}"
        arrays[f"{prefix}_time"] = one.subject.recording.time
        read = torch.where(one.subject.mask, one.subject.readings, torch.nan)
        arrays |= _prefixed(prefix, {"read": read} | {n: one.runs[n] for n in KEPT}, one.subject)
    return arrays


def _prefixed(prefix: str, values: Mapping[str, Tensor], subject: Subject) -> dict[str, Tensor]:
    return {f"{prefix}_{name}": _as_recorded(subject, each) for name, each in values.items()}


def _as_recorded(subject: Subject, values: Tensor) -> Tensor:
    """(S, C) in the plant's order of sensors -> in the recording's order, NaN for columns that no sensor has."""
    names = subject.recording.output_names
    shown = values.new_full((len(values), len(names)), torch.nan)
    for i, sensor in enumerate(subject.plant.sensors):
        shown[:, names.index(sensor.column)] = values[:, i]
    return shown
