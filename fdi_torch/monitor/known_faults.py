"""Known faults: changes of their size, the record of these, and whether a fault has recovered, or whether the readings
cannot show it any more.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from fdi_torch.monitor.alarm_state import State
from fdi_torch.monitor.event_text import Ends, EventWriter
from fdi_torch.monitor.events import Event
from fdi_torch.monitor.hypothesis import Fault, HypothesisFit
from fdi_torch.monitor.hypothesis_fit import changes_of
from fdi_torch.monitor.isolation import isolate
from fdi_torch.monitor.monitor_settings import REVISE
from fdi_torch.monitor.monitor_state import DetectedChange, FaultTrack, HiddenFault, MonitorState
from fdi_torch.monitor.observer_bank import ChangeHypotheses, ObserverBank, ObserverWindow, no_change, sudden_changes
from fdi_torch.parameters import ParameterSpace

# A change whose effect is below this share of the known faults' effect may be a change of their size.
SMALL_CHANGE = 1.0 / 3.0
# Difference of log evidence (nats) from which another fault explains the change better: "strong" (Kass and Raftery,
# 1995).
STRONG_EVIDENCE = 5.0


def size_change(
    observer: ObserverBank, state: MonitorState, start: float, faults: Sequence[Fault]
) -> HypothesisFit | None:
    """New sizes of the known faults since `start` s or later, or None if that does not explain the residual.

    None without a known fault, if one of them recovered, if the change is large, or if a new fault is clearly likelier.
    """
    off = state.off_nominal.nonzero().flatten().tolist()
    known = [f for f in faults if f.size in off]
    if not known:
        return None
    window, observer = state.window(start), observer.knowing(state.errors.constants)
    fits = isolate(observer, window, state.believed, known, deepest=len(known), healthy=state.healthy)
    best = next(f for f in fits if f.hypothesis.columns)
    near_nominal = (best.value - state.healthy).abs() <= 3.0 * best.std
    changed = (best.value - state.believed).abs() > 3.0 * best.std
    if best.hypothesis.recovered or any(bool((near_nominal & changed)[c]) for c in best.hypothesis.sizes):
        return None  # one of them recovered
    best = replace(best, value=torch.where(near_nominal, state.believed, best.value))
    if _relative_effect(observer, window, state, best) > SMALL_CHANGE:
        return None
    new = [f for f in faults if f.size not in off]
    if new:
        rival = isolate(observer, window, state.believed, new, deepest=1)[0]
        if (best.misfit - rival.misfit) / rival.misfit_ratio > STRONG_EVIDENCE:
            return None
    return best


def _relative_effect(
    observer: ObserverBank, window: ObserverWindow, state: MonitorState, change: HypothesisFit
) -> float:
    """Effect of a change of size on the white innovations over that of the known faults, root mean square."""
    groups = [list(columns) for columns in observer.effects if bool(state.off_nominal[list(columns)].any())]
    theta = torch.cat([change.value[None], state.believed.repeat(len(groups), 1)])
    for lane, columns in enumerate(groups, start=1):
        theta[lane, columns] = state.healthy[columns]
    lanes = sudden_changes(theta, change.onset)
    base = observer.white_innovations(window, state.believed, no_change(state.believed))
    moved, *removed = (observer.white_innovations(window, state.believed, lanes) - base).square().sum((1, 2)).tolist()
    return (moved / sum(removed)) ** 0.5 if sum(removed) > 0.0 else float("inf")


def effect_of_value(
    observer: ObserverBank, window: ObserverWindow, before: Tensor, change: ChangeHypotheses, column: int, value: float
) -> tuple[float, float]:
    """Effect on the white innovations of setting one parameter to another value after a change.

    Returns the root mean square of the difference, and the increase of the misfit (half the sum of squares).
    before (P,): parameters before the change, which has one lane.
    """
    theta = change.theta.repeat(2, 1)
    theta[1, column] = value
    lanes = ChangeHypotheses(theta, change.onset.repeat(2), change.incipient.repeat(2))
    since = window.times > float(change.onset)
    white, other = observer.white_innovations(window, before, lanes)[:, since]
    rms = float((other - white).square().mean().sqrt()) if bool(since.any()) else 0.0
    return rms, 0.5 * float(other.square().sum() - white.square().sum())


def updated_tracks(
    observer: ObserverBank, state: MonitorState, change: DetectedChange, faults: Sequence[Fault]
) -> MonitorState:
    """The state with one track for each fault that is present after a change."""
    fit, tracks, window, healthy = change.best, [], state.window(change.best.onset), state.healthy.tolist()
    for column in (fault.size for fault in faults):
        if float(state.believed[column]) == float(state.healthy[column]):
            continue
        earlier = next((t for t in state.tracks if t.column == column), None)
        if column not in fit.hypothesis.columns:
            tracks += [earlier] if earlier else []
            continue
        now, onset = (state.now, float(state.believed[column]), float(fit.std[column])), (fit.onset, fit.onset_std)
        effect, _ = effect_of_value(observer, window, change.before, changes_of([fit]), column, healthy[column])
        track = FaultTrack(column, change.number, *onset, now, now, effect, state.now)
        if earlier is not None and earlier.number == change.number:
            track = replace(track, first=earlier.first, announced=earlier.announced, adjusted=earlier.adjusted)
        start = fit.onset, float(change.before[column]), 0.0
        tracks.append(replace(track, first=start) if fit.hypothesis.incipient else track)
    return replace(state, tracks=tuple(tracks))


def with_new_sizes(state: MonitorState, fit: HypothesisFit) -> tuple[MonitorState, list[FaultTrack]]:
    """The state with new sizes of known faults, and the tracks to announce.

    A size is announced again once the fault has lasted REVISE times as long as at the last announcement.
    """
    tracks, due = [], []
    for t in state.tracks:
        if t.column in fit.hypothesis.columns:
            size, std = float(fit.value[t.column]), float(fit.std[t.column])
            t = replace(t, last=(state.now, size, std), adjusted=fit.onset)
            if state.now - t.onset >= REVISE * (t.announced - t.onset):
                t = replace(t, announced=state.now)
                due.append(t)
        tracks.append(t)
    return replace(state, tracks=tuple(tracks)), due


# Assumed error of a fault's model, as a share of the fault's effect: a real leak is not an ideal orifice.
FAULT_MODEL_ERROR = 0.1
END_CANDIDATES = 200  # times in a window at which a fault may have ended


def recovered_columns(space: ParameterSpace, change: DetectedChange) -> list[int]:
    """Columns of the faults that were present before a change and, by its likeliest explanation, no longer are."""
    return [c for c in change.best.hypothesis.sizes if _is_recovered(space, change, c)]


def _law_error(track: FaultTrack) -> float:
    """Three standard deviations of what the error of a fault's model moves in the white innovations."""
    return 3.0 * FAULT_MODEL_ERROR * track.effect_rms


def possible_ends(observer: ObserverBank, state: MonitorState, change: DetectedChange, lookback: float) -> Ends:
    """For each fault that ended at a change, the interval in which it may have ended, s; None if the standard deviation
    of the fitted onset describes it.

    In a dry tank the readings determine no onset, and the fitted one may be the time from which the fault's law is
    wrong. Another onset is possible if its misfit is at most that of three standard deviations larger, or if it changes
    the white innovations by less than the error of the fault's law, which is no larger than the noise if the fit leaves
    no more than that. What else changed keeps its onset, and to first order its effect.
    """
    if change.best.hypothesis.incipient:
        return {track.column: None for track in change.ended}
    return {track.column: _possible_end(observer, state, change, track, lookback) for track in change.ended}


def _possible_end(
    observer: ObserverBank, state: MonitorState, change: DetectedChange, ended: FaultTrack, lookback: float
) -> tuple[float, float] | None:
    """The interval of `possible_ends` for one fault, from runs that end it at up to END_CANDIDATES times."""
    best, window = change.best, state.window(max(change.best.onset - lookback, change.since))
    times = window.samples.time[:: max(len(window) // END_CANDIDATES, 1)]
    onsets = torch.cat([times, times.new_tensor([best.onset])])
    after = change.before.clone()
    after[ended.column] = best.value[ended.column]
    lanes = sudden_changes(after.repeat(len(onsets), 1), onsets)
    white = observer.white_innovations(window, change.before, lanes)
    white = white + (observer.white_innovations(window, change.before, changes_of([best])) - white[-1])
    misfits = 0.5 * white.square().sum((1, 2)) / best.misfit_ratio
    between = ((window.times > times[:, None]) != (window.times > best.onset)).to(white.dtype)
    moved = ((white[:-1] - white[-1]).square().mean(-1) * between).sum(-1) / between.sum(-1).clamp(min=1.0)
    law_error = min(_law_error(ended), 1.0 if best.fits else math.inf)
    possible = (misfits[:-1] - misfits[-1] <= 4.5) | (moved.sqrt() < law_error)
    earlier, later = times <= best.onset, times > best.onset
    first = min([best.onset, *_while(times[earlier].flip(0), possible[earlier].flip(0))])
    last = max([best.onset, *_while(times[later], possible[later])])
    step = float(torch.diff(times).max())
    reach = 3.0 * best.onset_std + step
    is_sharp = best.onset_std <= step and first >= best.onset - reach and last <= best.onset + reach
    return None if is_sharp else (first, last)


def _while(times: Tensor, possible: Tensor) -> list[float]:
    """The times up to the first that is not possible."""
    return times[possible.to(torch.int8).cumprod(0).to(torch.bool)].tolist()


def _end_is_shown(observer: ObserverBank, state: MonitorState, fault: HiddenFault, start: float) -> bool:
    """Whether the readings since `start` s would show a hidden fault, and contradict it."""
    window = state.window(start)
    present = sudden_changes(state.believed[None], window.samples.time[:1])
    effect, misfit = effect_of_value(observer, window, state.believed, present, fault.track.column, fault.size)
    return effect >= _law_error(fault.track) and misfit > STRONG_EVIDENCE


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


def with_hidden(
    observer: ObserverBank, state: MonitorState, change: DetectedChange, ends: Ends, latest: float
) -> MonitorState:
    """The state with the faults that recovered at a change but that the readings since would not show.

    Asked of all readings since the change, and of those of the last `latest` seconds alone: a pump with the fault may
    have run only in these.
    """
    best, starts = change.best, (change.best.onset, state.now - latest)
    earliest = {t.column: (ends[t.column] or (best.onset,))[0] for t in change.ended}
    ended = [HiddenFault(t, float(change.before[t.column]), earliest[t.column], state.now) for t in change.ended]
    new = [h for h in ended if not any(_end_is_shown(observer, state, h, max(s, best.onset)) for s in starts)]
    judged = {*best.hypothesis.columns, *state.off_nominal.nonzero().flatten().tolist()}
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
    writer: EventWriter,
    state: MonitorState,
    change: DetectedChange,
    reported: Sequence[HypothesisFit],
    ends: Ends,
    told: Sequence[FaultTrack],
) -> tuple[MonitorState, list[Event]]:
    """End the alarms of recovered faults; "cannot tell" if the readings would not show one of them any more.

    ends: see `possible_ends`. told: those that had recovered by earlier fits of the change.
    """
    events, unseen = [], [h.track.column for h in state.hidden]
    for number in sorted({t.number for t in change.ended}):
        ended, alarm = [t for t in change.ended if t.number == number], state.alarm(number)
        answer = State.CANNOT_TELL if any(t.column in unseen for t in ended) else State.RECOVERED
        differs = alarm.state is not answer
        state = state.with_alarm(alarm.with_state(answer)) if differs else state
        for kind in (State.CANNOT_TELL, State.RECOVERED):
            alike = [t for t in ended if (t.column in unseen) == (kind is State.CANNOT_TELL)]
            if any(t not in told for t in alike) or (alike and differs and kind is answer):
                columns = [t.column for t in alike]
                events.append(writer.ended(state, change, reported, number, columns, kind is State.RECOVERED, ends))
    return state, events
