"""The closure as the answer gives it: pooled, per sensor, per hold-out, in the unit shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fdi_torch.gap.ceiling import FROZEN, guilty_places
from fdi_torch.gap.closure import Closure, HeldOut, closure
from fdi_torch.gap.finding import Finding
from fdi_torch.gap.posterior import in_order
from fdi_torch.parameters import display_unit
from fdi_torch.plant.description import PlantDescription


def closure_in_full(held: Sequence[HeldOut], found: Finding) -> dict[str, Any]:
    """frozen: with the causes, but constants as recalibrated without them, or as believed: worse by what recalibration
    had taken for the causes, which would count twice. ceiling_at: where free functions stand beside the causes.
    """
    scales = _Scales.of(found.fitter.subject.plant)
    told = _numbers(closure(held), scales)
    answer = {
        "metric": "free-run RMSE on the hold-out, per sensor and pooled, in the sensor's unit",
        "unit": scales.unit,
        "units": dict(scales.units),
        **told,
        "augmented_with": [{"effect": n, "location": at} for n, at in in_order(found.best)],
        "ceiling_at": guilty_places(found),
        "holdouts": [h.subject.recording.source for h in held],
    }
    if len(held) > 1:
        answer["per_holdout"] = [{"source": h.subject.recording.source, **_numbers(closure([h]), scales)} for h in held]
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
