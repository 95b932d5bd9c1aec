"""The models whose free runs on a hold-out are compared: as believed, recalibrated, with the causes, with the causes
but other constants, and the ceiling.

The ceiling adds, to the causes, free functions of the guilty components' own variables: what no better equation of
these components could close either, as far as it keeps no memory. Its course in time belongs to the recording's clock
and stays out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from fdi_torch.gap.candidate_fit import Fit
from fdi_torch.gap.dataset import DataSet
from fdi_torch.gap.diagnosis_result import DiagnosisResult
from fdi_torch.gap.free_form import free_form
from fdi_torch.gap.free_form_coefficients import coefficients_of, without_time_course
from fdi_torch.gap.holdout import Closure, HeldOut, Model, closure, free_run, model_of
from fdi_torch.gap.posterior import causes_in_order
from fdi_torch.parameters import display_unit
from fdi_torch.plant.description import PlantDescription

FROZEN = {"recalibrated": "augmented_on_recalibrated", "nominal": "augmented_on_nominal"}


def reference_models(found: DiagnosisResult) -> dict[str, Model]:
    """All models by the names of the answer."""
    best = found.best
    return {
        "nominal": Model(),
        "recalibrated": model_of(found.null),
        "augmented": model_of(best),
        FROZEN["recalibrated"]: Model(best.candidate.placements, constants_of(found.null) | best.effect_values),
        FROZEN["nominal"]: Model(best.candidate.placements, best.effect_values),
        "ceiling": reference_model(found),
    }


def constants_of(fit: Fit) -> dict[str, float]:
    """The calibration constants of a fit and what it refitted of effects that the plant file has, without start levels
    and what further recordings have for themselves.
    """
    new = {p.prefix for p in fit.candidate.placements}
    lasting_names = [n for n in fit.space.names if "@" not in n and not n.endswith(".start_level")]
    return {n: fit.values[n] for n in lasting_names if n.rpartition(".")[0] not in new}


def reference_model(found: DiagnosisResult) -> Model:
    """The best explanation with free functions beside it, where it has a name; else it is the free form itself."""
    best, plant = found.best, found.fitter.data.plant
    if found.free_form_fit:
        return model_of(best)
    free = without_time_course([p for place in causal_places(found) for p in free_form(place, plant, found.reach)])
    taken: Mapping[str, float] = coefficients_of(found.fitter, best, free, found.reach).by_name()
    return Model((*best.candidate.placements, *free), {**best.values, **taken})


def causal_places(found: DiagnosisResult) -> list[str]:
    """Where the best explanation's causes are; the likeliest place where it has none."""
    places = list(dict.fromkeys(p.location for p in found.best.candidate.placements))
    return places or [found.posterior.places[0][0]]


def closure_to_dict(held: Sequence[HeldOut], found: DiagnosisResult) -> dict[str, Any]:
    """frozen: with the causes, but constants as recalibrated without them, or as believed: worse by what recalibration
    had taken for the causes, which would count twice. ceiling_at: where free functions stand beside the causes.
    """
    scales = _Scales.of(found.fitter.data.plant)
    told = _numbers(closure(held), scales)
    answer = {
        "metric": "free-run RMSE on the hold-out, per sensor and pooled, in the sensor's unit",
        "unit": scales.unit,
        "units": dict(scales.units),
        **told,
        "augmented_with": [{"effect": n, "location": at} for n, at in causes_in_order(found.best)],
        "ceiling_at": causal_places(found),
        "holdouts": [h.data.recording.source for h in held],
    }
    if len(held) > 1:
        answer["per_holdout"] = [{"source": h.data.recording.source, **_numbers(closure([h]), scales)} for h in held]
    return answer


@dataclass(frozen=True)
class _Scales:
    """unit, scale: in which errors of all sensors together are told; units, each: those of every sensor."""

    unit: str
    scale: float
    units: Mapping[str, str]
    each: Mapping[str, float]

    @classmethod
    def of(cls, plant: PlantDescription) -> _Scales:
        shown = {s.name: display_unit(s.unit) for s in plant.sensors}
        alike = len({s.unit for s in plant.sensors}) == 1
        unit, scale = next(iter(shown.values())) if alike else ("noise levels", 1.0)
        return cls(unit, scale, {n: u for n, (u, _) in shown.items()}, {n: x for n, (_, x) in shown.items()})


def _numbers(done: Closure, scales: _Scales) -> dict[str, Any]:
    pooled, frozen = _without_frozen(done.pooled, scales.scale)
    each = {sensor: _without_frozen(errors, scales.each[sensor])[0] for sensor, errors in done.per_sensor.items()}
    return {
        **pooled,
        "frozen": frozen,
        "per_sensor": each,
        "closed": done.closed,
        "closed_ci95": done.closed_ci95,
    }


def _without_frozen(errors: Mapping[str, float], scale: float) -> tuple[dict[str, float], dict[str, float]]:
    names = {model: constants for constants, model in FROZEN.items()}
    plain = {m: v * scale for m, v in errors.items() if m not in names}
    return plain, {names[m]: v * scale for m, v in errors.items() if m in names}


KEPT = ("nominal", "recalibrated", "augmented", "ceiling")


def prediction_arrays(found: DiagnosisResult, held: Sequence[HeldOut]) -> dict[str, Tensor]:
    """Arrays by name, SI, sensors in the order of the recording; hold-outs from the second on carry their number."""
    fitter = found.fitter
    arrays: dict[str, Tensor] = {}
    for k, rows in enumerate(fitter.data.rows):
        data = fitter.data.alone(k)
        predicted = {
            "nominal": free_run(data, fitter.noise, Model())[0],
            "recalibrated": found.null.linearised.readings[0, rows],
            "augmented": found.best.linearised.readings[0, rows],
        }
        prefix = "" if k == 0 else f"recording_{k + 1}_"
        arrays |= {f"{prefix}{name}": _as_recorded(data, values) for name, values in predicted.items()}
    for k, one in enumerate(held):
        prefix = "holdout" if k == 0 else f"holdout_{k + 1}"
        arrays[f"{prefix}_time"] = one.data.recording.time
        read = torch.where(one.data.mask, one.data.readings, torch.nan)
        arrays |= _prefixed(prefix, {"read": read} | {n: one.runs[n] for n in KEPT}, one.data)
    return arrays


def _prefixed(prefix: str, values: Mapping[str, Tensor], data: DataSet) -> dict[str, Tensor]:
    return {f"{prefix}_{name}": _as_recorded(data, each) for name, each in values.items()}


def _as_recorded(data: DataSet, values: Tensor) -> Tensor:
    """(S, C) in the plant's order of sensors -> in the recording's order, NaN for columns that no sensor has."""
    names = data.recording.output_names
    shown = values.new_full((len(values), len(names)), torch.nan)
    for i, sensor in enumerate(data.plant.sensors):
        shown[:, names.index(sensor.column)] = values[:, i]
    return shown
