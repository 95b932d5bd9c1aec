"""Alarms held against moments at which something is known to have changed: hits and their delay, misses, false ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Score:
    """hits: (moment of the change, delay of its first alarm) in s. misses: moments without one. false: other alarms."""

    hits: tuple[tuple[float, float], ...]
    misses: tuple[float, ...]
    false: tuple[float, ...]


def score(alarms: Sequence[float], changes: Sequence[float], early: float = 0.0, late: float = 30.0) -> Score:
    """A change is hit by the first alarm from `early` s before its moment (it takes a while itself) to `late` s after.

    Further alarms in that time count as false.
    """
    left, hits, misses = sorted(alarms), [], []
    for change in sorted(changes):
        own = next((alarm for alarm in left if -early <= alarm - change <= late), None)
        if own is None:
            misses.append(change)
        else:
            left.remove(own)
            hits.append((change, own - change))
    return Score(tuple(hits), tuple(misses), tuple(left))
