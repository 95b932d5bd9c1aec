"""Recovered faults: which are nominal again, whether readings would show it if they were not, and their alarms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from fdi_torch.monitor.alarm_state import State
from fdi_torch.monitor.event_text import EventWriter
from fdi_torch.monitor.events import Event
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


def _recovery_is_observable(
    observer: ObserverBank, state: MonitorState, change: DetectedChange, track: FaultTrack
) -> bool:
    """Whether the readings since the recovery would show the fault if it were still present.

    They would not if it adds less to the white innovations than three standard deviations of its model's error, the
    share FAULT_MODEL_ERROR of its earlier effect, for example in a dry tank or behind a closed valve.
    """
    window, size = state.window(change.best.onset), float(change.before[track.column])
    effect, _ = effect_of_value(observer, window, change.before, change.hypothesis, track.column, size)
    return effect >= 3.0 * FAULT_MODEL_ERROR * track.effect_rms


def _end_is_shown(observer: ObserverBank, state: MonitorState, fault: HiddenFault, start: float) -> bool:
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


def with_hidden(observer: ObserverBank, state: MonitorState, change: DetectedChange) -> MonitorState:
    """The state with the faults that recovered at a change but that the readings since would not show."""
    onset, now = change.best.onset, state.now
    hidden = [t for t in change.ended if not _recovery_is_observable(observer, state, change, t)]
    new = [HiddenFault(t, float(change.before[t.column]), onset, now) for t in hidden]
    judged = {*change.best.hypothesis.columns, *state.off_nominal.nonzero().flatten().tolist()}
    return replace(state, hidden=(*(h for h in state.hidden if h.track.column not in judged), *new))


def examine_hidden(
    observer: ObserverBank, writer: EventWriter, state: MonitorState, due: Sequence[HiddenFault]
) -> tuple[MonitorState, list[Event]]:
    """Report the hidden faults of which the readings since the last look show that they have ended."""
    gone = [h for h in due if _end_is_shown(observer, state, h, max(h.seen, state.valid_since))]
    hidden = (replace(h, seen=state.now) if h in due else h for h in state.hidden if h not in gone)
    state, events = replace(state, hidden=tuple(hidden)), []
    if state.change is not None:
        ended = tuple(t for t in state.change.ended if t not in [h.track for h in gone])
        state = replace(state, change=replace(state.change, ended=ended))
    standing = {t.number for t in (*state.tracks, *(h.track for h in state.hidden))}
    for number in sorted({h.track.number for h in gone}):
        if number not in standing and state.alarm(number).state is State.CANNOT_TELL:
            state = state.with_alarm(state.alarm(number).with_state(State.RECOVERED))
        events.append(writer.end_shown(state, number, [h for h in gone if h.track.number == number]))
    return state, events


def end_recovered(
    writer: EventWriter, state: MonitorState, change: DetectedChange, reported: Sequence[HypothesisFit]
) -> tuple[MonitorState, list[Event]]:
    """End the alarms of recovered faults; "cannot tell" if the readings would not show one of them any more."""
    events, unseen = [], [h.track.column for h in state.hidden]
    for number in sorted({t.number for t in change.ended}):
        columns, alarm = [t.column for t in change.ended if t.number == number], state.alarm(number)
        hidden = [c for c in columns if c in unseen]
        answer = State.CANNOT_TELL if hidden else State.RECOVERED
        if alarm.state is not answer:
            state = state.with_alarm(alarm.with_state(answer))
            names = [writer.space.names[c] for c in hidden or columns]
            events.append(writer.ended(state, change, reported, number, names, not hidden))
    return state, events
