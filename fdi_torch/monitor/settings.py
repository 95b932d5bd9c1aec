"""How a monitor looks back, and when it looks again."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MonitorSettings:
    """In seconds. lookback: how far before an alarm a change is sought. confirm: how long after an alarm the faults are
    told apart. revise: factor by which the time since the onset grows before sizes are estimated again. longest: a
    window never reaches further back. incipient: whether faults may also grow slowly. together: how many at once.
    level: share of the posterior that the explanations of an event hold together.
    """

    lookback: float = 300.0
    confirm: float = 60.0
    revise: float = 2.0
    longest: float = 1000.0
    incipient: bool = True
    together: int = 2
    level: float = 0.95

    def __post_init__(self) -> None:
        if not (self.lookback > 0 and self.confirm >= 0 and self.revise > 1 and self.longest >= self.lookback):
            raise ValueError(
                "expected lookback > 0, confirm >= 0, revise > 1 and longest >= lookback, "
                f"got {self.lookback:g} s, {self.confirm:g} s, {self.revise:g}, {self.longest:g} s; change them"
            )
