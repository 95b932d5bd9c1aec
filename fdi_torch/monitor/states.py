"""The states of a monitor and of its alarms, and which state may follow which.

The monitor learns, then watches. Each alarm is confirmed for a while and then isolated (one explanation holds 95 % of
the posterior), explained (several hold it) or left open ("cannot tell"); it ends recovered or retired. First and last
time, count and state of an alarm are those that an alarm log keeps (ISA-18.2, 2016, clause 16).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum


class State(StrEnum):
    LEARNING = "learning"
    WATCHING = "watching"
    CONFIRMING = "confirming"
    ISOLATED = "isolated"
    EXPLAINED = "explained"
    CANNOT_TELL = "cannot tell"
    RECOVERED = "recovered"
    RETIRED = "retired"


S = State
_OPEN = frozenset({S.ISOLATED, S.EXPLAINED, S.CANNOT_TELL})
_ANSWERS = _OPEN | {S.RECOVERED, S.RETIRED}
FOLLOWS: dict[State, frozenset[State]] = {
    S.LEARNING: frozenset({S.WATCHING}),
    S.WATCHING: frozenset({S.CONFIRMING}),
    S.CONFIRMING: _ANSWERS,
    **dict.fromkeys(_OPEN, _ANSWERS),
    # A later look, with more readings, may find that the fault still stands, or that the alarm had a cause of its own.
    S.RECOVERED: _OPEN | {S.RETIRED},
    S.RETIRED: _OPEN | {S.RECOVERED},
}


@dataclass(frozen=True)
class Alarm:
    """One alarm. number: from 1. first, last: when the residual left its range for it, s; count: how often.

    shares: of each sensor in the statistic that raised it. faults: parameters that the likeliest explanation changes.
    """

    number: int
    first: float
    last: float
    shares: tuple[tuple[str, float], ...] = ()
    state: State = State.CONFIRMING
    count: int = 1
    faults: tuple[str, ...] = ()

    @property
    def is_open(self) -> bool:
        return self.state in _OPEN or self.state is State.CONFIRMING

    def to(self, state: State) -> Alarm:
        """In another state. Raises ValueError where that does not follow."""
        if state not in FOLLOWS[self.state]:
            raise ValueError(f"alarm {self.number}: expected a state that follows '{self.state}', got '{state}'")
        return replace(self, state=state)

    def again(self, time: float) -> Alarm:
        """Raised once more."""
        return replace(self, last=time, count=self.count + 1)
