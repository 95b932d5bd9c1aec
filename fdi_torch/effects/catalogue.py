"""The catalogue of effects: what each is, where it can sit, its parameters, when it begins, and how it is written."""

from __future__ import annotations

import inspect
import sys
from dataclasses import dataclass

from fdi_torch.effects import EFFECTS, effect
from fdi_torch.parameters import Parameter
from fdi_torch.plant.description import OUTSIDE, Pipe, PlantDescription, Pump, Sensor, Tank
from fdi_torch.plant.effect import Effect, fits
from fdi_torch.tables import Shown, Table

# A rig with every kind of place, for what is asked without a plant.
_ANY = PlantDescription(
    "any plant",
    (Tank("T1", 0.02, 1.0), Tank("T2", 0.02, 1.0)),
    (Pipe("P12", "T1", "T2", 1e-4, 0.6, valve="v12"), Pipe("OUT", "T2", OUTSIDE, 1e-4, 0.6, valve="vOUT")),
    (Pump("Q1", "T1", 1e-4),),
    (Sensor("h1", "T1"), Sensor("h2", "T2")),
)
_ONSETS = ("onset", "begin")


@dataclass(frozen=True)
class Entry:
    """An effect of the library. meaning: in one sentence; law: its equation and source; at: the plant's places.

    parameters: with unit, nominal value, range and meaning, the size first; SI.
    """

    name: str
    meaning: str
    law: str
    stage: str
    kinds: tuple[str, ...]
    at: tuple[str, ...]
    parameters: tuple[Parameter, ...]
    mistaken_for: tuple[str, ...]

    @property
    def begins(self) -> str:
        """When it acts."""
        for parameter in self.parameters:
            if parameter.name in _ONSETS:
                return f"at `{parameter.name}` (0 s: from the start)"
        return "from the start of the recording"

    @property
    def in_a_run_file(self) -> str:
        """How `simulate.faults` has it; `estimate.parameters` has the name alone."""
        return f"{self.at[0]}.{self.name}.{self.parameters[0].name}: {_amount(self.parameters[0])}"

    @property
    def in_a_plant_file(self) -> str:
        """How a plant that is known to have it says so, under `effects`."""
        given = ", ".join(f"{p.name}: {_amount(p)}" for p in self.parameters)
        return f"- {{effect: {self.name}, location: {self.at[0]}, parameters: {{{given}}}}}"

    def table(self) -> Table:
        """A row a parameter, SI."""
        rows = [(p.name, p.unit, p.nominal, p.low, p.high, p.meaning) for p in self.parameters]
        return Table.of_rows(("parameter", "unit", "nominal", "lowest", "highest", "meaning"), rows)


@dataclass(frozen=True, repr=False)
class Catalogue(Shown):
    """The effects that a plant can have, by name: catalogue["leak"]."""

    plant: str
    entries: tuple[Entry, ...]

    def __getitem__(self, name: str) -> Entry:
        """Raises ValueError for an effect that is not among them."""
        found = next((entry for entry in self.entries if entry.name == name), None)
        if found is None:
            known = effect(name)
            raise ValueError(f"{name}: expected a plant with a {' or a '.join(known.places)}, got {self.plant}")
        return found

    def __len__(self) -> int:
        return len(self.entries)

    @property
    def headline(self) -> str:
        return f"{len(self.entries)} effects of {self.plant}"

    def table(self) -> Table:
        """A row an effect."""
        rows = [
            (e.name, e.meaning, list(e.kinds), list(e.at), ", ".join(_named(p) for p in e.parameters), e.begins)
            for e in self.entries
        ]
        return Table.of_rows(("effect", "meaning", "sits at a", "places", "parameters", "begins"), rows)


def effects(plant: PlantDescription | None = None) -> Catalogue:
    """The catalogue of faults and unmodelled effects.

    plant: of which places and ranges are told; None: of any plant, where ranges are those of a rig of 1 m height.
    """
    described = plant or _ANY
    entries = (_entry(each, described) for each in EFFECTS)
    return Catalogue(described.name, tuple(entry for entry in entries if entry is not None))


def _entry(each: Effect, plant: PlantDescription) -> Entry | None:
    """None where the plant has no place for it."""
    at = tuple(place for place in plant.locations() if fits(each, plant, place))
    if not at:
        return None
    return Entry(
        each.name,
        (sys.modules[type(each).__module__].__doc__ or "").split("\n\n")[0].replace("\n", " ").rstrip("."),
        inspect.cleandoc(type(each).__doc__ or ""),
        each.stage.value,
        each.places,
        at,
        each.parameters(at[0], plant),
        each.mistaken_for,
    )


def _named(parameter: Parameter) -> str:
    return parameter.name if parameter.unit == "1" else f"{parameter.name} ({parameter.unit})"


def _amount(parameter: Parameter) -> str:
    """A value as a file has it: a tenth of the range for what is nominal at zero, its nominal value otherwise."""
    value = parameter.nominal
    if value == 0.0 and parameter.name not in (*_ONSETS, "ramp"):
        value = 0.1 * (parameter.high if abs(parameter.high) < 1e6 else 1.0)
    return f"{value:.3g}" if parameter.unit == "1" else f"{value:.3g} {parameter.unit}"
