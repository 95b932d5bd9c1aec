"""Input of a law of the hidden rigs at one instant, and a rig's deviation from its plant file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]
Numbers = Mapping[str, Array]


@dataclass
class Moment:
    """Input of a pump's law at one instant.

    time: s on the recording's clock; dt: s; level (n,): of the pump's tank, m. asked(delay): flow that was requested
    `delay` seconds ago, (n,) s -> (n,) m^3/s.
    """

    time: float
    dt: float
    level: Array
    asked: Callable[[Array], Array]


@dataclass(frozen=True)
class Deviation:
    """One deviation of a hidden rig from its plant file.

    effect: name in the library, 'unknown' for a law outside it. location: the component. law: name of the equation.
    numbers: its parameters, SI. other: the second tank of a flow between tanks.
    """

    effect: str
    location: str
    law: str
    numbers: dict[str, float]
    other: str | None = None

    def as_dict(self) -> dict[str, Any]:
        return {name: value for name, value in asdict(self).items() if value is not None}
