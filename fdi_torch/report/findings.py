"""What a run found, whatever kind of run it was: effects at places, with their sizes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

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
    return [*faults.values(), *(_cause(cause) for cause in material.answer.get("causes", []))]


def _fault(message: Mapping[str, Any]) -> Finding:
    size, std, flow, hole = (_number(message.get(name)) for name in ("size", "size_std", "flow", "hole_diameter"))
    name, location, unit = (str(message.get(key, "")) for key in ("fault", "location", "unit"))
    return Finding(_effect_name(name), location, message.get("present") is True, size, std, unit, flow, hole)


def _effect_name(name: str) -> str:
    """'leak.size' -> 'leak'."""
    return name.removesuffix(".size")


def _cause(cause: Mapping[str, Any]) -> Finding:
    """The first parameter of an effect is its size."""
    size: Mapping[str, Any] = next(iter(cause.get("parameters", {}).values()), {})
    value, std = _number(size.get("value")), _number(size.get("std"))
    return Finding(str(cause["effect"]), str(cause["location"]), True, value, std, str(size.get("unit", "")))


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else NAN
