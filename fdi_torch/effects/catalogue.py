"""The catalogue of effects: the meaning, equation, places and parameters of each, and its notation in files."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fdi_torch.clock import MOMENTS
from fdi_torch.effects import EFFECTS, effect
from fdi_torch.parameters import Parameter
from fdi_torch.plant.description import FLOW_KINDS, OUTSIDE, Pipe, PlantDescription, Pump, Sensor, Tank
from fdi_torch.plant.effect import Effect, fits, place_kinds_of
from fdi_torch.quantities import quantity_text
from fdi_torch.tables import Shown, Table, in_display_unit, in_its_units

# A rig with every kind of place, the default if no plant is given.
_FURTHER: dict[str, Any] = {
    kind.part(): (kind.example(f"{kind.__name__}12", "T1", "T2"),) for kind in FLOW_KINDS if kind not in (Pipe, Pump)
}
_ANY = PlantDescription(
    "any plant",
    (Tank("T1", 0.02, 1.0), Tank("T2", 0.02, 1.0)),
    (Pipe("P12", "T1", "T2", 1e-4, 0.6, valve="v12"), Pipe("OUT", "T2", OUTSIDE, 1e-4, 0.6, valve="vOUT")),
    (Pump("Q1", "T1", 1e-4),),
    (Sensor("h1", "T1"), Sensor("h2", "T2")),
    **_FURTHER,
)


@dataclass(frozen=True, repr=False)
class Entry(Shown):
    """One effect of the catalogue.

    meaning: one sentence. law: equation and source. kinds: kinds of component. by_place: the parameters at each place
    of the plant, size first, with unit, nominal value, range and meaning, in SI.
    """

    name: str
    meaning: str
    law: str
    stage: str
    kinds: tuple[str, ...]
    by_place: Mapping[str, tuple[Parameter, ...]]
    mistaken_for: tuple[str, ...]

    @property
    def at(self) -> tuple[str, ...]:
        return tuple(self.by_place)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The parameters at the first place."""
        return self.by_place[self.at[0]]

    @property
    def headline(self) -> str:
        return f"{self.name}, at {self.where}: {self.meaning}"

    @property
    def where(self) -> str:
        """'a pump or a transfer', 'an outlet'."""
        return " or ".join(f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}" for kind in self.kinds)

    @property
    def begins(self) -> str:
        """When the effect starts to act, in words."""
        for parameter in self.parameters:
            if parameter.name in MOMENTS:
                return f"at `{parameter.name}` (0 s: from the start)"
        return "from the start of the recording"

    @property
    def in_a_run_file(self) -> str:
        """The fault as an entry of `simulate.faults` in a run file."""
        return f"{self.at[0]}.{self.name}.{self.parameters[0].name}: {self._amount(self.parameters[0])}"

    @property
    def in_a_plant_file(self) -> str:
        """The effect as an entry of `effects` in a plant file."""
        given = ", ".join(f"{p.name}: {self._amount(p)}" for p in self.parameters)
        return f"- {{effect: {self.name}, location: {self.at[0]}, parameters: {{{given}}}}}"

    @in_its_units
    def _amount(self, parameter: Parameter) -> str:
        """An example value for a file: the nominal value, moved by a tenth of the range if it is the size or zero."""
        value = parameter.nominal
        if parameter is self.parameters[0] or (value == 0.0 and parameter.name not in (*MOMENTS, "ramp")):
            up, down = parameter.high - value, value - parameter.low
            reach = up if up >= down or value == 0.0 else -down
            value += 0.1 * (reach if abs(reach) < 1e6 else 1.0)
        return quantity_text(value, parameter.unit, 3, f"{self.at[0]}.{self.name}.{parameter.name}")

    @in_its_units
    def rows(self) -> list[tuple[str, str, float, float, float, str]]:
        """Name, unit for display, nominal value, lowest, highest and meaning of each parameter; of one with several
        units, as readings of sensors have, a row for each, with its places.
        """
        rows = []
        for of_places in zip(*self.by_place.values(), strict=True):
            by_unit: dict[str, tuple[list[str], tuple[float, ...]]] = {}
            for place, p in zip(self.at, of_places, strict=True):
                unit, *numbers = in_display_unit(f"{place}.{self.name}.{p.name}", p.unit, p.nominal, p.low, p.high)
                by_unit.setdefault(unit, ([], tuple(numbers)))[0].append(place)
            for unit, (places, (nominal, low, high)) in by_unit.items():
                where = f" at {', '.join(places)}" if len(by_unit) > 1 else ""
                rows.append((f"{of_places[0].name}{where}", unit, nominal, low, high, of_places[0].meaning))
        return rows

    def table(self) -> Table:
        header = ("parameter", "unit", "nominal", "lowest", "highest", "meaning")
        return Table(header, self.rows(), words=len(header))


@dataclass(frozen=True, repr=False)
class Catalogue(Shown):
    """The effects that a plant can have, by name: catalogue["leak"]."""

    plant: str
    entries: tuple[Entry, ...]

    def __getitem__(self, name: str) -> Entry:
        """Raises ValueError for an unknown effect, or one that the plant has no place for."""
        entry = next((e for e in self.entries if e.name == name), None)
        if entry is None:
            requested = effect(name)
            raise ValueError(
                f"{name}: expected a plant with a {' or a '.join(place_kinds_of(requested))}, got {self.plant}"
            )
        return entry

    def __len__(self) -> int:
        return len(self.entries)

    @property
    def headline(self) -> str:
        return f"{len(self.entries)} effects of {self.plant}"

    def table(self) -> Table:
        """One row per effect."""
        rows = [
            (e.name, e.meaning, list(e.kinds), list(e.at), ", ".join(_named(p) for p in e.parameters), e.begins)
            for e in self.entries
        ]
        return Table(("effect", "meaning", "sits at a", "places", "parameters", "begins"), rows)


def effects(plant: PlantDescription | None = None) -> Catalogue:
    """The catalogue of faults and unmodelled effects.

    plant: determines places and parameter ranges; None for a generic rig with tanks of 1 m.
    """
    subject = plant or _ANY
    entries = (_entry(each, subject) for each in EFFECTS)
    return Catalogue(subject.name, tuple(entry for entry in entries if entry is not None))


def _entry(each: Effect, plant: PlantDescription) -> Entry | None:
    """The catalogue entry of an effect; None if the plant has no place for it."""
    at = tuple(place for place in plant.locations() if fits(each, plant, place))
    if not at:
        return None
    return Entry(
        each.name,
        (sys.modules[type(each).__module__].__doc__ or "").split("\n\n")[0].replace("\n", " ").rstrip("."),
        inspect.cleandoc(type(each).__doc__ or ""),
        each.stage.value,
        place_kinds_of(each),
        {place: each.parameters(place, plant) for place in at},
        each.mistaken_for,
    )


def _named(parameter: Parameter) -> str:
    return parameter.name if parameter.unit == "1" else f"{parameter.name} ({parameter.unit})"
