"""Parameters: physical numbers with name, unit, nominal value, range, prior and meaning.

A `ParameterSpace` is an ordered set of `Parameter`s; it maps names to the last dimension of tensors (*batch, P). All
values are SI.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, TypeVar

import torch

from fdi_torch.names import unknown

Value = TypeVar("Value")


@dataclass(frozen=True, slots=True)
class ParameterName:
    """The name of a parameter in its parts: 'T1.area' is a component's constant, 'T1.leak.size' an effect's parameter.

    `str()` gives the form of YAML files, logs and keys of mappings. place: component or pair of tanks, '' for gravity.
    effect: '' for a constant. recording: k for 'T1.start_level@k', a value that belongs to one recording alone; 0 else.
    """

    place: str
    effect: str
    field: str
    recording: int = 0

    @staticmethod
    @lru_cache(maxsize=4096)
    def parse(text: str) -> ParameterName:
        """'T1.leak.size' -> its parts. Whether they exist is left to the plant and to the library of effects."""
        name, _, recording = text.rpartition("@")
        if not recording.isdecimal():
            name, recording = text, "0"
        place, _, at_place = name.partition(".") if "." in name else ("", "", name)
        effect, _, field = at_place.rpartition(".")
        return ParameterName(place, effect, field, int(recording))

    @staticmethod
    def of_effect(text: str) -> ParameterName:
        """The name of an effect ('T1.leak', with an empty field) or of one of its parameters ('T1.leak.size')."""
        return ParameterName.parse(text if text.count(".") != 1 else f"{text}.")

    def __str__(self) -> str:
        text = ".".join(part for part in (self.place, self.effect, self.field) if part)
        return f"{text}@{self.recording}" if self.recording else text

    @property
    def prefix(self) -> str:
        """All but the field: 'T1.leak' for an effect at a place, 'T1' for a component's constant."""
        return f"{self.place}.{self.effect}" if self.effect else self.place

    @property
    def at_place(self) -> str:
        """All but the place: 'leak.size', 'area'."""
        return f"{self.effect}.{self.field}" if self.effect else self.field

    def sibling(self, field: str) -> ParameterName:
        """Another parameter of the same effect or component."""
        return replace(self, field=field)

    @property
    def is_constant(self) -> bool:
        """Whether a component has this parameter, as opposed to an effect or to the whole plant."""
        return bool(self.place) and not self.effect


def name_in_recording(name: str, recording: int) -> str:
    """Name of a constant that differs between recordings: 'L.start_level', 'L.start_level@1' ..."""
    return str(replace(ParameterName.parse(name), recording=recording))


def common_name(name: str) -> str:
    """The same name for all recordings: 'L.start_level@1' -> 'L.start_level'."""
    return name_in_recording(name, 0)


def is_effect_parameter(name: str) -> bool:
    """Whether the name is that of an effect's parameter: 'T1.leak.size'."""
    return bool(ParameterName.parse(name).effect)


def by_prefix(values: Mapping[str, Value]) -> dict[str, dict[str, Value]]:
    """Values by full name -> by prefix and field: {'T1.leak.size': v} -> {'T1.leak': {'size': v}}."""
    grouped: dict[str, dict[str, Value]] = {}
    for text, value in values.items():
        name = ParameterName.parse(text)
        grouped.setdefault(name.prefix, {})[name.field] = value
    return grouped


@dataclass(frozen=True)
class Parameter:
    """One scalar that can be estimated.

    name: `component.field` or `component.effect.parameter`, unique in its space. unit: SI unit of all numbers below.
    nominal: mean of the prior. low, high: bounds of the search. std: standard deviation of the prior; infinite for a
    flat prior. extremes: bounds that are physical limits, such as a closed pipe; the other bounds are guesses.
    """

    name: str
    unit: str
    nominal: float
    low: float = -math.inf
    high: float = math.inf
    std: float = math.inf
    meaning: str = ""
    extremes: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not self.low <= self.nominal <= self.high:
            raise ValueError(
                f"{self.name}: expected low <= nominal <= high, "
                f"got {self.low:g}, {self.nominal:g}, {self.high:g} {self.unit.removeprefix('1')}".rstrip()
                + "; widen the range, or give a nominal within it"
            )
        if not self.std > 0:
            raise ValueError(f"{self.name}: expected a positive standard deviation, got {self.std} {self.unit}")


class ParameterSpace:
    """An ordered set of parameters, the names of the last dimension of tensors (*batch, P)."""

    def __init__(self, parameters: Iterable[Parameter] = ()) -> None:
        self.parameters = tuple(parameters)
        self._index = {p.name: i for i, p in enumerate(self.parameters)}
        if len(self._index) < len(self.parameters):
            doubled = [p.name for i, p in enumerate(self.parameters) if self._index[p.name] != i]
            raise ValueError(f"expected each parameter once, got {doubled[0]} twice; remove one")

    def __repr__(self) -> str:
        units = ["" if p.unit == "1" else f" {p.unit}" for p in self]
        return "\n".join(
            f"{p.name} = {p.nominal:g}, {p.low:g} to {p.high:g}{u}" for p, u in zip(self, units, strict=True)
        )

    def __len__(self) -> int:
        return len(self.parameters)

    def __iter__(self) -> Iterator[Parameter]:
        return iter(self.parameters)

    def __getitem__(self, name: str) -> Parameter:
        return self.parameters[self.index(name)]

    def __contains__(self, name: str) -> bool:
        return name in self._index

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(p.name for p in self.parameters)

    def index(self, name: str) -> int:
        if name not in self._index:
            raise ValueError(unknown("a parameter", name, self.names))
        return self._index[name]

    def with_changes(self, name: str, **changes: Any) -> ParameterSpace:
        """The same space with fields of one parameter replaced."""
        self.index(name)
        return ParameterSpace(replace(p, **changes) if p.name == name else p for p in self.parameters)

    def nominal(self, like: torch.Tensor | None = None) -> torch.Tensor:
        return self._column("nominal", like)

    def low(self, like: torch.Tensor | None = None) -> torch.Tensor:
        return self._column("low", like)

    def high(self, like: torch.Tensor | None = None) -> torch.Tensor:
        return self._column("high", like)

    def std(self, like: torch.Tensor | None = None) -> torch.Tensor:
        return self._column("std", like)

    def _column(self, field: str, like: torch.Tensor | None) -> torch.Tensor:
        values = [getattr(p, field) for p in self.parameters]
        return torch.tensor(values, dtype=torch.float64) if like is None else like.new_tensor(values)

    def vector(self, values: Mapping[str, float]) -> torch.Tensor:
        """Nominal values (P,) with some replaced by name."""
        theta = self.nominal()
        for name, value in values.items():
            theta[self.index(name)] = value
        return theta

    def named(self, theta: torch.Tensor) -> dict[str, torch.Tensor]:
        """Split (*batch, P) into one tensor (*batch) per name."""
        if theta.shape[-1] != len(self):
            raise ValueError(
                f"expected a last dimension of {len(self)} ({', '.join(self.names)}), got {theta.shape[-1]}"
            )
        return dict(zip(self.names, theta.unbind(-1), strict=True))
