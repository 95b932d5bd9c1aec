"""Events of a monitor, and their text. Terminal, report page, log and JSON show the same event."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

from fdi_torch.amounts import amount_words, estimate_words, parameter_words, percent_text, sized_words
from fdi_torch.clock import clock_text
from fdi_torch.estimate.uncertainty import end_reached, plain_value
from fdi_torch.monitor.alarm_state import State
from fdi_torch.parameters import Parameter, ParameterName, ParameterSpace
from fdi_torch.quantities import display_unit, quantity_text, significant

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
FORMAT = "fdi_torch.event/3"
SMALLEST_SHARE = 0.05  # headlines name explanations with at least this probability, and sensors with this share
MOST_NAMED = 3  # explanations of a headline; the event has all
NO_FLOW = 1e-12  # m^3/s, a drop in half a day: what the smoothed law of an orifice leaves of a flow from an empty tank


@dataclass(frozen=True)
class Size:
    """One parameter that an explanation changes. size, std: in `unit`, SI; shown: the value as text with a
    practical unit.

    at_end: whether the estimate reached an end of its range. Then `size` is that end, the true value lies there or
    beyond, and std is infinite. rate: growth of an incipient fault, in `unit` per s. flow: of a fault that adds
    one, such as a leak, at the present levels, m^3/s; otherwise None.
    """

    name: str
    size: float
    std: float
    unit: str
    shown: str
    at_end: bool = False
    rate: float | None = None
    flow: float | None = None

    @property
    def amounts(self) -> tuple[str, ...]:
        """'size 0.300 ± 0.020', '12.1 cm^3/s now'."""
        if self.flow is None:
            return (self.shown,)
        flow = self.flow if abs(self.flow) >= NO_FLOW else 0.0
        return self.shown, f"{quantity_text(flow, 'm^3/s', 3)} now"


@dataclass(frozen=True)
class Explanation:
    """One possible cause of an alarm. mass: its posterior probability. Without sizes: chance, or a cause `unlisted`.

    onset, onset_std: s. growing: an incipient fault. ended: those of the parameters that are back to nominal.
    """

    mass: float
    sizes: tuple[Size, ...]
    onset: float | None = None
    onset_std: float | None = None
    growing: bool = False
    ended: tuple[str, ...] = ()
    unlisted: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(s.name for s in self.sizes)

    @property
    def text(self) -> str:
        return self._in_words(lambda sizes: sized_words(sizes[0].name, [a for s in sizes for a in s.amounts]))

    @property
    def causes(self) -> str:
        """The text without sizes."""
        return self._in_words(lambda sizes: parameter_words(sizes[0].name))

    def _in_words(self, words: Callable[[Sequence[Size]], str]) -> str:
        """'leak at A (size 0.200 ± 0.010), with leak at B back to nominal'. words: of the sizes of one fault."""
        faults = _by_effect(self.sizes)
        present = " and ".join(words(sizes) for sizes in faults if sizes[0].name not in self.ended)
        back = " and ".join(parameter_words(sizes[0].name) for sizes in faults if sizes[0].name in self.ended)
        both = ", with " if present and back else ""
        no_fault = "a cause that is not on the list" if self.unlisted else "chance"
        return f"{present}{both}{back}{' back to nominal' if back else ''}" or no_fault

    def restricted_to(self, names: Sequence[str]) -> Explanation:
        """The explanation with the sizes of some parameters only."""
        return replace(self, sizes=tuple(s for s in self.sizes if s.name in names))


@dataclass(frozen=True)
class Limit:
    """Forecast of when a tank overflows or runs dry if the inputs keep the mean of the last `lookback` s.

    No controller is simulated: one that reacts to the fault changes the time.

    time: median, s from the event; low, high: 90 % interval, infinite if it may never happen. chance: probability that
    it happens at all.
    """

    tank: str
    what: Literal["overflows", "runs dry"]
    time: float
    low: float
    high: float
    chance: float

    @property
    def text(self) -> str:
        median, low = significant(self.time, 3), significant(self.low, 3)
        high = f"{significant(self.high, 3)} s" if math.isfinite(self.high) else "never"
        return f"{self.tank} {self.what} in {median} s (90 %: {low} s to {high}) if the inputs keep their recent mean"


@dataclass(frozen=True)
class Event:
    """Event of a monitor.

    time: of the sample that caused it, s. text: for people. alarm: number of the alarm, 0 for none; state: of that
    alarm, else of the monitor, after the event. explanations: the fewest with 95 % of the posterior, likeliest first.
    shares: of each sensor in the detector's statistic. limits: forecast of overflow and dry tanks. first, last, count:
    first and last crossing of the threshold, s, and their number. delay: from onset to alarm, s. severity: urgency from
    the plant file, or empty. announced: whether the fault is large enough to announce. believed: the parameters that
    the observer uses with a value other than nominal (SI).
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
    def head(self) -> str:
        """Time, clock time if the recording has one, and kind: the part of the line before the text."""
        moment = f"{clock}  " if (clock := clock_text(self.time)) else ""
        return f"{self.time:10.1f} s  {moment}{self.kind:<11} "

    @property
    def line(self) -> str:
        """Head, text and clock time of the onset if the recording has one."""
        onset = "" if self.onset is None or self.kind == "followed" else clock_text(self.onset)
        return f"{self.head}{self.text}{f' (onset {onset})' if onset else ''}"

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
        """SI units of `sizes` and `stds`."""
        return tuple(s.unit for s in self.best.sizes) if self.best else ()

    @property
    def onset(self) -> float | None:
        return self.best.onset if self.best else None

    @property
    def onset_std(self) -> float | None:
        return self.best.onset_std if self.best else None

    @property
    def masses(self) -> dict[str, float]:
        """The probability that each parameter has changed, summed over the explanations."""
        total: dict[str, float] = {}
        for e in self.explanations:
            for name in (n for n in e.names if n not in e.ended):
                total[name] = total.get(name, 0.0) + e.mass
        return total

    @property
    def growing(self) -> bool:
        return self.best is not None and self.best.growing

    @property
    def headline(self) -> str:
        """The likeliest explanations, with their probabilities if there are several."""
        return headline(self.explanations)

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON and logs."""
        fields = asdict(self) | {"state": str(self.state)}
        likeliest = {"faults": self.faults, "sizes": self.sizes, "stds": self.stds, "onset": self.onset}
        return plain_value(fields | likeliest | {"onset_std": self.onset_std, "headline": self.headline}, "event")


def headline(explanations: Sequence[Explanation], sizes: bool = True) -> str:
    """The explanations above 5 %, likeliest first, with their probabilities if there are several; of more than
    `MOST_NAMED` the others' number. sizes: name them.
    """
    above = [e for k, e in enumerate(explanations) if k == 0 or e.mass >= SMALLEST_SHARE]
    named, others = above[:MOST_NAMED], above[MOST_NAMED:]
    texts = [e.text if sizes else e.causes for e in named]
    if len(named) == 1:
        return texts[0]
    said = [f"{text}, {percent_text(e.mass)}" for text, e in zip(texts, named, strict=True)]
    said += [f"{len(others)} more, {percent_text(sum(e.mass for e in others))} (see the log)"] if others else []
    return ", or ".join(said)


def _by_effect(sizes: Sequence[Size]) -> list[list[Size]]:
    grouped: dict[str, list[Size]] = {}
    for size in sizes:
        grouped.setdefault(ParameterName.parse(size.name).prefix, []).append(size)
    return list(grouped.values())


def size_of(p: Parameter, size: float, std: float, rate: float | None = None) -> Size:
    """A parameter's estimate as events report it."""
    end = end_reached(p, size)
    if end is None:
        return Size(p.name, size, std, p.unit, estimate_words(p.name, p.unit, size, std), rate=rate)
    unit, scale = display_unit(p.unit, p.name)
    most = f"at {'least' if end == p.high else 'most'} {scale * end:.4g}"
    shown = f"{amount_words(p.name, most, unit)}, the end of its range"
    return Size(p.name, end, math.inf, p.unit, shown, at_end=True)


def rates_text(sizes: Sequence[Size], space: ParameterSpace) -> str:
    """'; bias changes by 1.2 cm per hour' for the sizes that grow, or per day for slow changes; each with its fault if
    there are several."""
    words = []
    for s in (s for s in sizes if s.rate is not None):
        p, rate, (unit, scale) = space[s.name], s.rate or 0.0, display_unit(s.unit, s.name)
        span, name = (3600.0, "hour") if abs(rate) * 86400.0 > abs(p.high - p.low) * 0.01 else (86400.0, "day")
        change = f"{significant(scale * rate * span, 3)} {unit}".rstrip()
        whose = f" of {parameter_words(s.name)}" if len(sizes) > 1 else ""
        words.append(f"; {ParameterName.parse(s.name).field}{whose} changes by {change} per {name}")
    return "".join(words)


def shares_text(shares: Sequence[tuple[str, float]]) -> str:
    """'h1 81 %, h3 19 %': the sensors with the largest shares of an alarm."""
    largest = sorted((s for s in shares if s[1] >= SMALLEST_SHARE), key=lambda s: -s[1])
    return ", ".join(f"{name} {percent_text(share)}" for name, share in largest)
