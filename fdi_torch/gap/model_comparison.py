"""The reference models: their definition, their errors on the hold-outs, and their predictions, as the answer shows
them.

    nominal         the plant file
    recalibrated    with the constants fitted
    augmented       with the causes
    augmented_on_*  with the causes, but nominal or recalibrated constants
    ceiling         with the causes, and free functions of the variables of their components

The ceiling is the limit of any memoryless equation of these components. Functions of time belong to the clock of one
recording and are left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from fdi_torch.gap.candidate import Fit
from fdi_torch.gap.cause_hypothesis import causes_in_order
from fdi_torch.gap.dataset import DataSet, at_recorded_times
from fdi_torch.gap.diagnosis_result import DiagnosisResult
from fdi_torch.gap.free_form import free_form
from fdi_torch.gap.free_form_coefficients import coefficients_of, without_time_course
from fdi_torch.gap.holdout import HeldOut, Model, closure, free_run, model_of
from fdi_torch.parameters import ParameterName
from fdi_torch.quantities import display_unit

FROZEN = {"recalibrated": "augmented_on_recalibrated", "nominal": "augmented_on_nominal"}


def reference_models(result: DiagnosisResult) -> dict[str, Model]:
    """All models, by the names of the answer."""
    best = result.best
    return {
        "nominal": Model(),
        "recalibrated": model_of(result.null),
        "augmented": model_of(best),
        FROZEN["recalibrated"]: Model(best.candidate.placements, constants_of(result.null) | best.effect_values),
        FROZEN["nominal"]: Model(best.candidate.placements, best.effect_values),
        "ceiling": free_form_model(result),
    }


def constants_of(fit: Fit) -> dict[str, float]:
    """Calibration constants and refitted effects of the plant file, without values specific to one recording."""
    new = {p.prefix for p in fit.candidate.placements}
    names = {n: ParameterName.parse(n) for n in fit.space.names}
    constants = [n for n, name in names.items() if not name.recording and name.field != "start_level"]
    return {n: fit.values[n] for n in constants if names[n].prefix not in new}


def free_form_model(result: DiagnosisResult) -> Model:
    """The best explanation with free functions added, or as it is if it already has the free form of an unknown."""
    best, plant = result.best, result.fitter.data.plant
    if result.free_form_fit:
        return model_of(best)
    free = without_time_course(
        [p for place in causal_places(result) for p in free_form(place, plant, result.operating_range)]
    )
    coefficients: Mapping[str, float] = coefficients_of(result.fitter, best, free, result.operating_range).by_name()
    return Model((*best.candidate.placements, *free), {**best.values, **coefficients})


def causal_places(result: DiagnosisResult) -> list[str]:
    """Places of the best explanation's causes; the likeliest place if it has none."""
    places = list(dict.fromkeys(p.location for p in result.best.candidate.placements))
    return places or [result.posterior.places[0][0]]


def closure_to_dict(holdouts: Sequence[HeldOut], result: DiagnosisResult) -> dict[str, Any]:
    """The closure as the answer contains it: pooled, per sensor, per hold-out.

    frozen: with the causes, but constants recalibrated without them, or nominal. ceiling_at: places of the free
    functions.
    """
    units = {s.name: display_unit(s.unit, s.column) for s in result.fitter.data.plant.sensors}
    different = set(units.values())
    pooled_in = different.pop() if len(different) == 1 else ("noise levels", 1.0)

    def errors(of: Sequence[HeldOut]) -> dict[str, Any]:
        done = closure(of)
        pooled = _in_unit(done.pooled, pooled_in)
        each = {sensor: _in_unit(rmse, units[sensor]) for sensor, rmse in done.per_sensor.items()}
        return {
            **_not_frozen(pooled),
            "frozen": {constants: pooled[model] for constants, model in FROZEN.items()},
            "per_sensor": {sensor: _not_frozen(rmse) for sensor, rmse in each.items()},
            "closed": done.closed,
            "closed_ci95": done.closed_ci95,
        }

    answer = {
        "metric": "free-run RMSE on the hold-out, per sensor and pooled, in the sensor's unit",
        "unit": pooled_in[0],
        "units": {sensor: unit for sensor, (unit, _) in units.items()},
        **errors(holdouts),
        "augmented_with": [{"effect": n, "location": at} for n, at in causes_in_order(result.best)],
        "ceiling_at": causal_places(result),
        "holdouts": [h.data.recording.source for h in holdouts],
    }
    if len(holdouts) > 1:
        answer["per_holdout"] = [{"source": h.data.recording.source, **errors([h])} for h in holdouts]
    return answer


def _in_unit(errors: Mapping[str, float], unit: tuple[str, float]) -> dict[str, float]:
    """Errors of each model in a unit with its scale."""
    return {model: error * unit[1] for model, error in errors.items()}


def _not_frozen(errors: Mapping[str, float]) -> dict[str, float]:
    return {model: error for model, error in errors.items() if model not in FROZEN.values()}


SHOWN = ("nominal", "recalibrated", "augmented", "ceiling")


def prediction_arrays(result: DiagnosisResult, holdouts: Sequence[HeldOut]) -> dict[str, Tensor]:
    """Predictions in SI by name, for the recorded samples and sensors; names of further hold-outs end in a number."""
    fitter = result.fitter
    arrays: dict[str, Tensor] = {}
    for k, rows in enumerate(fitter.data.rows):
        data = fitter.data.alone(k)
        predicted = {
            "nominal": free_run(data, fitter.noise, Model()),
            "recalibrated": result.null.linearised.readings[0, rows],
            "augmented": result.best.linearised.readings[0, rows],
        }
        prefix = "" if k == 0 else f"recording_{k + 1}_"
        arrays |= {f"{prefix}{name}": _as_recorded(data, values) for name, values in predicted.items()}
    for k, holdout in enumerate(holdouts):
        prefix = "holdout" if k == 0 else f"holdout_{k + 1}"
        arrays[f"{prefix}_time"] = holdout.data.recording.time
        arrays[f"{prefix}_read"] = torch.where(holdout.data.recording.mask, holdout.data.recording.outputs, torch.nan)
        arrays |= {f"{prefix}_{name}": _as_recorded(holdout.data, holdout.runs[name]) for name in SHOWN}
    return arrays


def _as_recorded(data: DataSet, values: Tensor) -> Tensor:
    """Readings (S, C) of the plant's sensors, in their order, as columns and samples of the recording; NaN in columns
    without a sensor."""
    names, values = data.recording.output_names, at_recorded_times(data, values)
    arranged = values.new_full((len(values), len(names)), torch.nan)
    for i, sensor in enumerate(data.plant.sensors):
        arranged[:, names.index(sensor.column)] = values[:, i]
    return arranged
