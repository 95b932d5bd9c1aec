"""The interface of a flow component: one kind of component through which water enters, leaves or passes between tanks.

A kind is one file of `plant.kinds` and one field of `PlantDescription`. Its class declares all that other parts of the
program ask of it: the keys of a plant file with their units, its flow law, the smoothing at its kinks, the constants
that can be estimated, its drawing, and the effects that can be placed on it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import ClassVar, Self

import torch

from fdi_torch.plant.components import OUTSIDE, Component
from fdi_torch.plant.local_conditions import Local, Values

Point = tuple[float, float]


class FlowOrder(IntEnum):
    """The order in which the flows of a plant are computed.

    The last two depend on the net inflow of their source, so that all other flows, and the BALANCE effects, come first.
    """

    INFLOW = 0
    BY_LEVELS = 1
    SUPPLY = 2
    SPILL = 3


@dataclass(frozen=True)
class Sketch:
    """The drawing of a component.

    route: 'pipe' (out of the tank's floor or wall), 'over_wall' (over a wall and down), or 'from_above' (into the
    target from outside). height: m above the source's floor at which it leaves. arrow: whether it shows the direction.
    symbol: a polygon across the line, in units of a tank's width, for a line from left to right; round: the radius of a
    circle around it.
    """

    route: str
    height: float = 0.0
    arrow: bool = True
    symbol: tuple[Point, ...] = ()
    round: float = 0.0


class FlowComponent(Component):
    """Base of all kinds of flow component, each a frozen dataclass with fields `name` and, except for pumps, `source`.

    order: when its flow is computed. commanded: whether an input channel rather than a head sets its flow. place_kinds:
    the values that `place_kind` can have. accepts: names of the effects that can be placed on it, beside those whose
    places include its `place_kind`. usual_faults: size parameters of its most frequent faults.
    """

    order: ClassVar[FlowOrder]
    commanded: ClassVar[bool] = False
    place_kinds: ClassVar[tuple[str, ...]]
    accepts: ClassVar[tuple[str, ...]] = ()
    usual_faults: ClassVar[tuple[str, ...]] = ()

    source: str
    target: str

    @classmethod
    def part(cls) -> str:
        """Its section in plant files, and its field of `PlantDescription`."""
        return f"{cls.__name__.lower()}s"

    @classmethod
    def example(cls, name: str, source: str, target: str) -> Self:
        """A component of usual size for tanks of about 100 cm^2 and 50 cm, for the contract tests and the catalogue.

        With 5 cm of head it carries about as much as a pump of 70 cm^3/s, up to some times that.
        """
        raise NotImplementedError

    def constants(self) -> list[tuple[str, str, str]]:
        """Field, unit and role ('estimated' or 'constant', see `quantity_field`) of each constant of its flow law."""
        return [
            (f.name, f.metadata["unit"] if "unit" in f.metadata else getattr(self, f.metadata["unit_field"]), role)
            for f in fields(self)  # type: ignore[arg-type]
            if (role := f.metadata.get("role"))
        ]

    def positive_fields(self) -> list[tuple[str, str]]:
        """Field and unit of each constant that must be positive; a gain may be negative."""
        of_fixed_unit = {f.name for f in fields(self) if "unit" in f.metadata}  # type: ignore[arg-type]
        return [(name, unit) for name, unit, role in self.constants() if role == "estimated" and name in of_fixed_unit]

    @property
    def near_tank(self) -> str:
        """The tank whose level counts as the component's own: its source, or the target of a flow from outside."""
        return self.target if self.source == OUTSIDE else self.source

    @property
    def depends_on(self) -> tuple[str, ...]:
        """The tanks whose levels drive the flow; the flow grows with the first level and falls with the second."""
        return ()

    @property
    def datum(self) -> float:
        """Level at which the driving head is zero if only the source drives the flow, m above its floor."""
        return 0.0

    @property
    def falls(self) -> bool:
        """Whether it pours into its target from above."""
        return False

    @property
    def input_channel(self) -> tuple[str, str] | None:
        """Input channel that sets the flow or the opening, and its SI unit; None for a passive component."""
        return None

    @property
    def full_command(self) -> float:
        """Largest useful value of the input channel, in its SI unit."""
        return 1.0

    def problems(self) -> Iterator[str]:
        """Impossible values, each as 'field: expected ..., got ...', beyond numbers that must be positive."""
        return iter(())

    def actuated(self, value: torch.Tensor) -> torch.Tensor:
        """The command or opening within its range."""
        return value

    def capacity(self, constants: Values, gravity: torch.Tensor) -> torch.Tensor:
        """Flow at 1 m of head, or for a command of 1, by the present constants."""
        raise NotImplementedError

    def smoothing_width(self, gravity: float, inverse_areas: float, resolution: torch.Tensor) -> torch.Tensor | None:
        """Head below which square roots and divisors are smoothed, m, at the time scale `resolution` (s).

        inverse_areas: sum of 1/A over the tanks at both ends, 1/m^2: d(head)/dt per unit of flow. None, for a law
        without a head: its tank is smoothed over the width of its leak reference.
        """
        return None

    def head(self, local: Local) -> torch.Tensor:
        """Driving head, m, from the levels and constants of `local`."""
        return local.level

    def law(self, local: Local) -> torch.Tensor:
        """Nominal flow from source to target, m^3/s, before effects."""
        raise NotImplementedError

    def limited(self, flow: torch.Tensor, local: Local) -> torch.Tensor:
        """The flow after effects, limited so that the levels stay stable at a step of `local.clock.resolution`.

        Only kinds of order SUPPLY and SPILL have the net inflow of their source in `local.net`.
        """
        return flow

    def sketch(self) -> Sketch:
        """Its drawing."""
        raise NotImplementedError


LARGEST_DISCHARGE_COEFFICIENT = 10.0
"""Orifices have about 0.6 and wide pipes somewhat more; a larger number is probably in per cent."""


def coefficient_problems(coefficient: float) -> Iterator[str]:
    """The problem of a discharge coefficient that is given in per cent."""
    if not coefficient <= LARGEST_DISCHARGE_COEFFICIENT:
        yield (
            f"discharge_coefficient: expected at most {LARGEST_DISCHARGE_COEFFICIENT:g}, got {coefficient:g}; "
            "is it in per cent?"
        )
