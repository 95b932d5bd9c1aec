"""Known faults whose size changes: detection of a mere change of size, and the record of each fault's size."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from fdi_torch.monitor.hypothesis import Fault, HypothesisFit
from fdi_torch.monitor.isolation import isolate
from fdi_torch.monitor.monitor_state import DetectedChange, FaultTrack, MonitorState
from fdi_torch.monitor.observer_bank import ChangeHypotheses, ObserverBank, ObserverWindow, no_change

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
    window = state.window(start)
    fits = isolate(observer, window, state.believed, known, incipient=False, deepest=len(known), healthy=state.healthy)
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
        rival = isolate(observer, window, state.believed, new, incipient=False, deepest=1)[0]
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
    sudden = torch.zeros(len(theta), dtype=torch.bool)
    lanes = ChangeHypotheses(theta, torch.full((len(theta),), change.onset, dtype=theta.dtype), sudden)
    base = observer.white_innovations(window, state.believed, no_change(state.believed))
    moved, *removed = (observer.white_innovations(window, state.believed, lanes) - base).square().sum((1, 2)).tolist()
    return (moved / sum(removed)) ** 0.5 if sum(removed) > 0.0 else float("inf")


def effect_of_value(
    observer: ObserverBank, window: ObserverWindow, before: Tensor, change: ChangeHypotheses, column: int, value: float
) -> tuple[float, float]:
    """What another value of a parameter after a change adds to the white innovations since then: its root mean square,
    and the misfit (half a sum of squares) with it less that without it.

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
    state: MonitorState, change: DetectedChange, sizes: Sequence[int], effect_rms: Callable[[int], float]
) -> MonitorState:
    """The state with one track for each fault that is present after a change.

    sizes: columns of the faults' sizes. effect_rms: of a column, what the fault adds to the white residuals.
    """
    fit, tracks = change.best, []
    for column in sizes:
        if float(state.believed[column]) == float(state.healthy[column]):
            continue
        earlier = next((t for t in state.tracks if t.column == column), None)
        if column not in fit.hypothesis.columns:
            tracks += [earlier] if earlier else []
            continue
        now = state.now, float(state.believed[column]), float(fit.std[column])
        if earlier is not None and earlier.number == change.number:
            start = (fit.onset, float(change.before[column]), 0.0) if fit.hypothesis.incipient else earlier.first
            tracks.append(replace(earlier, onset=fit.onset, first=start, last=now, effect_rms=effect_rms(column)))
            continue
        start = (fit.onset, float(change.before[column]), 0.0) if fit.hypothesis.incipient else now
        tracks.append(FaultTrack(column, change.number, fit.onset, start, now, effect_rms(column), state.now))
    return replace(state, tracks=tuple(tracks))


def with_new_sizes(state: MonitorState, fit: HypothesisFit, revise: float) -> tuple[MonitorState, list[FaultTrack]]:
    """The state with new sizes of known faults, and the tracks to announce.

    A size is announced again once the fault has lasted `revise` times as long as at the last announcement.
    """
    tracks, due = [], []
    for t in state.tracks:
        if t.column in fit.hypothesis.columns:
            size, std = float(fit.value[t.column]), float(fit.std[t.column])
            t = replace(t, last=(state.now, size, std), adjusted=fit.onset)
            if state.now - t.onset >= revise * (t.announced - t.onset):
                t = replace(t, announced=state.now)
                due.append(t)
        tracks.append(t)
    return replace(state, tracks=tuple(tracks)), due
