"""The closure as the answer gives it: pooled, per sensor, per hold-out, in the unit shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from fdi_torch.gap.ceiling import FROZEN, guilty_places
from fdi_torch.gap.closure import Closure, HeldOut, closure
from fdi_torch.gap.finding import Finding, in_order
from fdi_torch.parameters import display_unit


def closure_in_full(held: Sequence[HeldOut], found: Finding) -> dict[str, Any]:
    """frozen: with the causes, but constants as recalibrated without them, or as believed: worse by what recalibration
    had taken for the causes, which would count twice. ceiling_at: where free functions stand beside the causes.
    """
    unit, scale = display_unit(held[0].subject.plant.sensors[0].unit)
    told = _numbers(closure(held), scale)
    answer = {
        "metric": "free-run RMSE on the hold-out, per sensor and pooled, in the sensor's unit",
        "unit": unit,
        **told,
        "augmented_with": [{"effect": n, "location": at} for n, at in in_order(found.best)],
        "ceiling_at": guilty_places(found),
        "holdouts": [h.subject.recording.source for h in held],
    }
    if len(held) > 1:
        answer["per_holdout"] = [{"source": h.subject.recording.source, **_numbers(closure([h]), scale)} for h in held]
    return answer


def _numbers(done: Closure, scale: float) -> dict[str, Any]:
    pooled, frozen = _without_frozen(done.pooled, scale)
    return {
        **pooled,
        "frozen": frozen,
        "per_sensor": {sensor: _without_frozen(errors, scale)[0] for sensor, errors in done.per_sensor.items()},
        "closed": done.closed,
        "closed_ci95": done.closed_ci95,
    }


def _without_frozen(errors: Mapping[str, float], scale: float) -> tuple[dict[str, float], dict[str, float]]:
    names = {model: constants for constants, model in FROZEN.items()}
    plain = {m: v * scale for m, v in errors.items() if m not in names}
    return plain, {names[m]: v * scale for m, v in errors.items() if m in names}
