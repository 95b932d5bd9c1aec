"""What a run found, whatever kind of run it was: effects at places, with their sizes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fdi_torch.effects import effect
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import fits
from fdi_torch.report.material import Material

NAN = float("nan")


@dataclass(frozen=True)
class Finding:
    """effect at location. size and std in `unit` (SI); flow m^3/s, hole m where it moves water; NaN: unknown."""

    effect: str
    location: str
    present: bool
    size: float = NAN
    std: float = NAN
    unit: str = ""
    flow: float = NAN
    hole: float = NAN

    @property
    def words(self) -> str:
        """'leak at T1'."""
        return f"{self.effect.replace('_', ' ')} at {self.location}"


def findings(material: Material) -> list[Finding]:
    """Faults of a diagnosis (the last word on each), then the causes of a gap."""
    faults = {(m.get("fault"), m.get("location")): _fault(m) for m in material.of("/diagnosis/fault")}
    return [*faults.values(), *(_cause(cause, material.plant) for cause in material.answer.get("causes", []))]


def _fault(message: Mapping[str, Any]) -> Finding:
    size, std, flow, hole = (as_number(message.get(name)) for name in ("size", "size_std", "flow", "hole_diameter"))
    name, location, unit = (str(message.get(key, "")) for key in ("fault", "location", "unit"))
    return Finding(_effect_name(name), location, message.get("present") is True, size, std, unit, flow, hole)


def fault_at(name: str) -> tuple[str, str]:
    """A parameter's full name, 'L.leak.size', as an effect in words and its place: 'leak', 'L'."""
    place, _, fault = name.partition(".")
    return (_effect_name(fault).replace("_", " "), place) if fault else (name, "")


def _effect_name(name: str) -> str:
    """'leak.size' -> 'leak', 'sensor_bias.bias' -> 'sensor_bias'."""
    return name.partition(".")[0]


def _cause(cause: Mapping[str, Any], plant: PlantDescription | None) -> Finding:
    """A log may hold the parameters in any order: which is the size, the effect itself says."""
    name, location, parameters = str(cause["effect"]), str(cause["location"]), cause.get("parameters", {})
    size: Mapping[str, Any] = parameters.get(_size_of(name, location, plant)) or next(iter(parameters.values()), {})
    value, std = as_number(size.get("value")), as_number(size.get("std"))
    return Finding(name, location, True, value, std, str(size.get("unit", "")))


def _size_of(name: str, location: str, plant: PlantDescription | None) -> str:
    """The short name of an effect's size; empty where the library or the plant lacks it."""
    try:
        placed = plant is not None and fits(effect(name), plant, location)
    except ValueError:
        return ""
    return effect(name).parameters(location, plant)[0].name if placed and plant is not None else ""


def as_number(value: Any) -> float:
    """A number of a log, or NaN."""
    return float(value) if isinstance(value, int | float) else NAN
