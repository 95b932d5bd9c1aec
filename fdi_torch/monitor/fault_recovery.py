"""Recovered faults: which faults are back at nominal, and whether the readings would show it if they were not."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from fdi_torch.monitor.fault_tracking import STRONG_EVIDENCE, effect_of_value
from fdi_torch.monitor.hypothesis import HypothesisFit
from fdi_torch.monitor.monitor_state import DetectedChange, FaultTrack, HiddenFault, MonitorState
from fdi_torch.monitor.observer_bank import ChangeHypotheses, ObserverBank
from fdi_torch.parameters import ParameterSpace

# Assumed error of a fault's model, as a share of the fault's effect: a real leak is not an ideal orifice.
FAULT_MODEL_ERROR = 0.1


def recovered_columns(space: ParameterSpace, change: DetectedChange) -> list[int]:
    """Columns of the faults that were present before a change and, by its likeliest explanation, no longer are."""
    return [c for c in change.best.hypothesis.sizes if _is_recovered(space, change, c)]


def recovery_is_observable(
    observer: ObserverBank, state: MonitorState, change: DetectedChange, track: FaultTrack
) -> bool:
    """Whether the readings since the recovery would show the fault if it were still present.

    They would not if it adds less to the white innovations than three standard deviations of its model's error, the
    share FAULT_MODEL_ERROR of its earlier effect, for example in a dry tank or behind a closed valve.
    """
    window, size = state.window(change.best.onset), float(change.before[track.column])
    effect, _ = effect_of_value(observer, window, change.before, change.hypothesis, track.column, size)
    return effect >= 3.0 * FAULT_MODEL_ERROR * track.effect_rms


def end_is_shown(observer: ObserverBank, state: MonitorState, fault: HiddenFault, start: float) -> bool:
    """Whether the readings since `start` s would show a hidden fault, and contradict it."""
    window = state.window(start)
    present = ChangeHypotheses(state.believed[None], window.samples.time[:1], torch.tensor([False]))
    effect, misfit = effect_of_value(observer, window, state.believed, present, fault.track.column, fault.size)
    return effect >= 3.0 * FAULT_MODEL_ERROR * fault.track.effect_rms and misfit > STRONG_EVIDENCE


def reset_to_nominal(space: ParameterSpace, change: DetectedChange, recovered: Sequence[int]) -> Tensor:
    """Parameters (P,) for the observer: nominal where the estimate agrees with nominal.

    A known fault whose estimate is too uncertain to show a recovery keeps its earlier size.
    """
    believed = change.best.value.clone()
    for c in change.best.hypothesis.sizes:
        if _is_nominal(space, change.best, c):
            nominal = space.parameters[c].nominal
            persists = float(change.before[c]) != nominal and c not in recovered
            believed[c] = change.before[c] if persists else nominal
    return believed


def _is_nominal(space: ParameterSpace, fit: HypothesisFit, column: int) -> bool:
    """Whether an estimate lies within three standard deviations of nominal."""
    return abs(float(fit.value[column]) - space.parameters[column].nominal) <= 3.0 * float(fit.std[column])


def _is_recovered(space: ParameterSpace, change: DetectedChange, column: int) -> bool:
    """Whether a parameter was off nominal, is nominal now, and the readings distinguish the two values."""
    before, value = float(change.before[column]), float(change.best.value[column])
    distinct = abs(before - value) > 3.0 * float(change.best.std[column])
    return before != space.parameters[column].nominal and _is_nominal(space, change.best, column) and distinct
