"""Diagnosed effects of a run: effect, location and size."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fdi_torch.amounts import amount_words, with_error
from fdi_torch.effects import effect
from fdi_torch.estimate.combinations import Combination
from fdi_torch.estimate.rival_faults import RivalFaults
from fdi_torch.gap.verdict_words import apart_from_rounding, cause_words, equivalents_words
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import fits
from fdi_torch.quantities import display_unit, quantity_text
from fdi_torch.report.material import Material
from fdi_torch.report.numbers import as_float

NAN = float("nan")


@dataclass(frozen=True)
class DiagnosedEffect:
    """An effect at a location. quantity: name of the parameter whose value is `size`, with its std in `unit` (SI).

    flow in m^3/s and hole diameter in m for effects that move water; NaN if unknown.
    """

    effect: str
    location: str
    present: bool
    size: float = NAN
    std: float = NAN
    unit: str = ""
    flow: float = NAN
    hole: float = NAN
    quantity: str = "size"
    end: str = ""
    """'low' or 'high' if the size lies at that end of its range."""
    equivalents: str = ""
    """Other effects that act alike, ', or equivalently leak at B'."""

    @property
    def words(self) -> str:
        """'leak at T1', 'something unknown at Q1'."""
        return cause_words({"effect": self.effect, "location": self.location})

    @property
    def sized(self) -> str:
        """'leak at T1 (size 0.3000 ± 0.0020, 33.1 cm³/s)': the effect with its size and, if it has one, its flow."""
        name = f"{self.location}.{self.effect}.{self.quantity}"
        unit, scale = display_unit(self.unit, name)
        value = with_error(scale * self.size, scale * self.std, self.end)
        sizes = [amount_words(name, value, unit)] if math.isfinite(self.size) else []
        sizes += [quantity_text(self.flow, "m^3/s", 3)] if math.isfinite(self.flow) else []
        return f"{self.words} ({', '.join(sizes)})" if sizes else self.words


def diagnosed_effects(material: Material) -> list[DiagnosedEffect]:
    """Faults of a diagnosis, from the last message about each, and causes of a gap other than rounded readings."""
    faults = {
        (m.get("fault"), m.get("location")): _fault(m, material.run.at_bounds) for m in material.of("/diagnosis/fault")
    }
    causes = apart_from_rounding(material.answer.get("causes", []))
    return [*faults.values(), *(_cause(cause, material.plant) for cause in causes)]


def _fault(message: Mapping[str, Any], at_bounds: Mapping[str, str]) -> DiagnosedEffect:
    size, std, flow, hole = (as_float(message.get(name)) for name in ("size", "size_std", "flow", "hole_diameter"))
    name, location, unit = (str(message.get(key, "")) for key in ("fault", "location", "unit"))
    fault = ParameterName.of_effect(f"{location}.{name}")
    quantity = fault.field or "size"
    end = at_bounds.get(f"{location}.{fault.effect}.{quantity}", "")
    return DiagnosedEffect(
        fault.effect, location, message.get("present") is True, size, std, unit, flow, hole, quantity, end
    )


def combinations_of(material: Material, result: str) -> list[Combination]:
    """Determined combinations in the run's result: all 'combinations', or those of faults that are 'not_isolated'."""
    try:
        return [Combination.from_dict(plain) for plain in material.listed(result)]
    except (KeyError, TypeError, ValueError) as error:
        material.problems.append(f"the result's {result.replace('_', ' ')} are unreadable: {error}")
        return []


def rivals_of(material: Material) -> list[RivalFaults]:
    """The rival faults in the run's result, if there are any."""
    try:
        return [RivalFaults.from_dict(plain) for plain in material.listed("rivals")]
    except (KeyError, TypeError, ValueError) as error:
        material.problems.append(f"the result's rivals are unreadable: {error}")
        return []


def _cause(cause: Mapping[str, Any], plant: PlantDescription | None) -> DiagnosedEffect:
    """A log may hold the parameters in any order: which is the size, the effect itself says."""
    name, location, parameters = str(cause["effect"]), str(cause["location"]), cause.get("parameters", {})
    quantity = _size_of(name, location, plant)
    quantity = quantity if quantity in parameters else next(iter(parameters), "size")
    size: Mapping[str, Any] = parameters.get(quantity, {})
    value, std = as_float(size.get("value")), as_float(size.get("std"))
    others = equivalents_words({"same_as": cause.get("same_as") or []})
    unit = str(size.get("unit", ""))
    flow = as_float(cause.get("flow"))
    return DiagnosedEffect(name, location, True, value, std, unit, flow, quantity=quantity, equivalents=others)


def _size_of(name: str, location: str, plant: PlantDescription | None) -> str:
    """The short name of an effect's size; empty where the library or the plant lacks it."""
    try:
        placed = plant is not None and fits(effect(name), plant, location)
    except ValueError:
        return ""
    return effect(name).parameters(location, plant)[0].name if placed and plant is not None else ""
