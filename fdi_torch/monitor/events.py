"""What a monitor has to say: one event, one line."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

Kind = Literal["alarm", "isolated", "revised", "recovered", "unexplained", "estimate", "notice"]


@dataclass(frozen=True)
class Event:
    """time: when it became known, s. faults, sizes, stds, units: in the same order, SI. onset, onset_std s.

    delay: from onset to alarm, s. rivals: other explanations that fit nearly as well. text: for people.
    """

    time: float
    kind: Kind
    text: str
    faults: tuple[str, ...] = ()
    sizes: tuple[float, ...] = ()
    stds: tuple[float, ...] = ()
    units: tuple[str, ...] = ()
    onset: float | None = None
    onset_std: float | None = None
    incipient: bool = False
    delay: float | None = None
    rivals: tuple[str, ...] = ()

    @property
    def line(self) -> str:
        return f"{self.time:10.1f} s  {self.kind:<11} {self.text}"

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON and logs; tuples become lists, what does not apply is None."""
        return {key: list(value) if isinstance(value, tuple) else value for key, value in asdict(self).items()}
