"""States of a monitor and of its alarms, and the allowed transitions.

The monitor learns the noise, then watches. An alarm is confirming for a while; then it is isolated (one explanation has
95 % of the posterior), explained (several have it together) or "cannot tell". It ends recovered or retired. First and
last time, count and state are the fields of an alarm log (ISA-18.2, 2016, clause 16).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fdi_torch.monitor.events import Explanation


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
    # With more readings, a later fit may show that the fault is still present, or that the alarm had its own cause.
    S.RECOVERED: _OPEN | {S.RETIRED},
    S.RETIRED: _OPEN | {S.RECOVERED},
}


@dataclass(frozen=True)
class Alarm:
    """One alarm. number: from 1. first, last: time of the first and last threshold crossing, s; count: of crossings.

    shares: of each sensor in the detector's statistic. explanations: those of its last answer, likeliest first; of the
    first, the faults that did not recover.
    """

    number: int
    first: float
    last: float
    shares: tuple[tuple[str, float], ...] = ()
    state: State = State.CONFIRMING
    count: int = 1
    explanations: tuple[Explanation, ...] = ()

    def with_state(self, state: State) -> Alarm:
        """The alarm in another state. Raises ValueError for a transition that is not allowed."""
        if state not in FOLLOWS[self.state]:
            raise ValueError(f"alarm {self.number}: expected a state that follows '{self.state}', got '{state}'")
        return replace(self, state=state)

    def raised_again(self, time: float) -> Alarm:
        """The alarm after another threshold crossing."""
        return replace(self, last=time, count=self.count + 1)
