"""Faults that went away: which, and whether the readings since could show that."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from fdi_torch.monitor.change import ChangedObserver, Changes
from fdi_torch.monitor.following import OFF, Change, MonitorState, Track
from fdi_torch.monitor.hypothesis import Finding
from fdi_torch.parameters import ParameterSpace


def gone_columns(space: ParameterSpace, change: Change) -> list[int]:
    """The faults that stood before a change and, by its likeliest explanation, no longer do."""
    return [c for c in change.finding.hypothesis.sizes if _is_back(space, change, c)]


def is_observable(observer: ChangedObserver, state: MonitorState, change: Change, track: Track) -> bool:
    """Whether the readings since a fault went away would show it if it still stood.

    They would not where it adds less to them than OFF of what it added when it was sized, in a dry tank or behind a
    closed valve: its law is not trusted any further.
    """
    window = state.window(change.finding.onset)
    still = change.finding.value.clone()
    still[track.column] = change.before[track.column]
    theta = torch.stack([change.finding.value, still])
    lanes = Changes(theta, torch.full((2,), change.finding.onset, dtype=theta.dtype), torch.tensor([False, False]))
    gone, stands = observer.white(window, change.before, lanes)
    since = window.times > change.finding.onset
    shows = float((gone - stands)[since].square().mean().sqrt()) if bool(since.any()) else 0.0
    return shows >= OFF * track.strength


def with_nominals(space: ParameterSpace, change: Change, back: Sequence[int]) -> Tensor:
    """Values (P,) to believe in: nominal where that is within the error, unless a fault that stands is so as well."""
    believed = change.finding.value.clone()
    for c in change.finding.hypothesis.sizes:
        if _is_nominal(space, change.finding, c):
            nominal = space.parameters[c].nominal
            stands = float(change.before[c]) != nominal and c not in back
            believed[c] = change.before[c] if stands else nominal
    return believed


def _is_nominal(space: ParameterSpace, finding: Finding, column: int) -> bool:
    """Whether what was found is nominal, to three standard errors."""
    return abs(float(finding.value[column]) - space.parameters[column].nominal) <= 3.0 * float(finding.std[column])


def _is_back(space: ParameterSpace, change: Change, column: int) -> bool:
    """Whether what was off nominal is nominal now, and the readings tell the two apart."""
    before, value = float(change.before[column]), float(change.finding.value[column])
    apart = abs(before - value) > 3.0 * float(change.finding.std[column])
    return before != space.parameters[column].nominal and _is_nominal(space, change.finding, column) and apart
