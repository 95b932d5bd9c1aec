"""What a monitor says: typed events, and their text. Terminal, page, log and JSON show the same event."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from fdi_torch.monitor.states import State
from fdi_torch.parameters import Parameter, display_unit

Kind = Literal[
    "watching",
    "alarm",
    "isolated",
    "explained",
    "cannot tell",
    "revised",
    "followed",
    "recovered",
    "retired",
    "summary",
    "estimate",
    "notice",
]
FORMAT = "fdi_torch.event/2"
RIVAL = 0.05  # of the posterior: from here on a headline names an explanation


@dataclass(frozen=True)
class Size:
    """One parameter that an explanation changes. size, std: in `unit`, SI; shown: the same in a person's unit.

    at_end: whether it ended at an end of its range, so that the true one may lie beyond. rate: of a fault that grows,
    in `unit` per s.
    """

    name: str
    size: float
    std: float
    unit: str
    shown: str
    at_end: bool = False
    rate: float | None = None


@dataclass(frozen=True)
class Explanation:
    """One set of changes that may have raised an alarm, and its share of the posterior. Without sizes: nothing changed,
    the alarm came by chance. onset, onset_std: s. gone: the faults went away.
    """

    mass: float
    sizes: tuple[Size, ...]
    onset: float | None = None
    onset_std: float | None = None
    growing: bool = False
    gone: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(s.name for s in self.sizes)

    @property
    def words(self) -> str:
        if not self.sizes:
            return "chance"
        shown = " + ".join(s.shown for s in self.sizes)
        return shown.replace(" = ", " back to ") if self.gone else shown


@dataclass(frozen=True)
class Limit:
    """When a tank overflows or runs dry if nothing changes. time: s from the event, the median; low, high: between
    which it lies with 90 % probability, infinite where it may never come. chance: that it comes at all.
    """

    tank: str
    what: Literal["overflows", "runs dry"]
    time: float
    low: float
    high: float
    chance: float

    @property
    def words(self) -> str:
        high = f"{self.high:.3g} s" if math.isfinite(self.high) else "never"
        return f"{self.tank} {self.what} in {self.time:.3g} s (90 %: {self.low:.3g} s to {high}) if nothing changes"


@dataclass(frozen=True)
class Event:
    """time: when it became known, s. text: for people. alarm: the number of the alarm that it is about, 0 for none;
    state: of that alarm, else of the monitor, after the event.

    explanations: the fewest that hold 95 % of the posterior, likeliest first. shares: of each sensor in the statistic
    that raised the alarm. limits: what comes if nothing changes. first, last, count: when the alarm was raised first
    and last, s, and how often. delay: from onset to alarm, s. severity: from the plant file, empty where it says
    nothing; announced: whether the fault is large enough to be said aloud. believed: every parameter that the monitor
    then believes off nominal, with its value (SI).
    """

    time: float
    kind: Kind
    text: str
    alarm: int = 0
    state: State = State.WATCHING
    explanations: tuple[Explanation, ...] = ()
    shares: tuple[tuple[str, float], ...] = ()
    limits: tuple[Limit, ...] = ()
    first: float | None = None
    last: float | None = None
    count: int | None = None
    delay: float | None = None
    severity: str = ""
    announced: bool = True
    believed: tuple[tuple[str, float], ...] = field(default=())

    @property
    def line(self) -> str:
        return f"{self.time:10.1f} s  {self.kind:<11} {self.text}"

    @property
    def best(self) -> Explanation | None:
        return self.explanations[0] if self.explanations else None

    @property
    def faults(self) -> tuple[str, ...]:
        """The parameters that the likeliest explanation changes."""
        return self.best.names if self.best else ()

    @property
    def sizes(self) -> tuple[float, ...]:
        return tuple(s.size for s in self.best.sizes) if self.best else ()

    @property
    def stds(self) -> tuple[float, ...]:
        return tuple(s.std for s in self.best.sizes) if self.best else ()

    @property
    def units(self) -> tuple[str, ...]:
        """Of sizes and stds, SI."""
        return tuple(s.unit for s in self.best.sizes) if self.best else ()

    @property
    def onset(self) -> float | None:
        return self.best.onset if self.best else None

    @property
    def onset_std(self) -> float | None:
        return self.best.onset_std if self.best else None

    @property
    def masses(self) -> dict[str, float]:
        """The probability that each parameter has changed, over the explanations that are told."""
        found: dict[str, float] = {}
        for e in self.explanations:
            for name in e.names if not e.gone else ():
                found[name] = found.get(name, 0.0) + e.mass
        return found

    @property
    def growing(self) -> bool:
        return self.best is not None and self.best.growing

    @property
    def headline(self) -> str:
        """Every explanation above 5 %, with its share where there are several."""
        return headline(self.explanations)

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON and logs."""
        told: dict[str, Any] = _plain(asdict(self))
        likeliest = {"faults": self.faults, "sizes": self.sizes, "stds": self.stds, "onset": self.onset}
        return {**told, **_plain({**likeliest, "onset_std": self.onset_std}), "headline": self.headline}


def headline(explanations: Sequence[Explanation]) -> str:
    told = [e for k, e in enumerate(explanations) if k == 0 or e.mass >= RIVAL]
    if len(told) == 1:
        return told[0].words
    return " or ".join(f"{e.words} ({percent(e.mass)})" for e in told)


def percent(mass: float) -> str:
    return "over 99 %" if mass > 0.99 else f"{100.0 * mass:.0f} %" if mass >= 0.01 else "under 1 %"


def amount(p: Parameter, size: float, std: float, at_end: bool = False) -> str:
    """'Q1.pump_offset.offset = 23.1 ± 0.4 cm^3/s', in the unit in which people read it."""
    unit, scale = display_unit(p.unit)
    error = f" ± {scale * std:.2g}" if std > 0.0 and not at_end else ""
    end = ", the end of its range" if at_end else ""
    return f"{p.name} = {scale * size:.4g}{error} {unit}".rstrip() + end


def rate_words(p: Parameter, rate: float) -> str:
    """'1.2 cm per hour', in the time that makes the number readable."""
    unit, scale = display_unit(p.unit)
    span, name = (3600.0, "hour") if abs(rate) * 86400.0 > abs(p.high - p.low) * 0.01 else (86400.0, "day")
    return f"{scale * rate * span:.3g} {unit} per {name}".replace("  ", " ")


def shares_words(shares: Sequence[tuple[str, float]]) -> str:
    """'h1 81 %, h3 19 %': the sensors that hold most of an alarm."""
    told = sorted((s for s in shares if s[1] >= RIVAL), key=lambda s: -s[1])
    return ", ".join(f"{name} {percent(share)}" for name, share in told)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, State) else value
