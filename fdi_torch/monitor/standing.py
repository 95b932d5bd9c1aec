"""Faults that stand: their sizes followed as they change."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch

from fdi_torch.monitor.change import ChangedObserver, Changes, Window, unchanged
from fdi_torch.monitor.following import Change, MonitorState, Track
from fdi_torch.monitor.hypothesis import Fault, Finding
from fdi_torch.monitor.isolation import isolate

# A change by less than this share of the effect of the faults that stand is theirs, and no event.
SLIGHT = 1.0 / 3.0
# By how much another fault must explain such a change better, nats: "strong" (Kass and Raftery, 1995).
CLEARLY = 5.0


def changed_size(
    observer: ChangedObserver, state: MonitorState, start: float, faults: Sequence[Fault], choices: int
) -> Finding | None:
    """New sizes, since `start` or later, of the faults that stand, where they change slightly and no other fault says
    more of it; None where nothing stands, or something else happens.
    """
    off = (state.believed != state.healthy).nonzero().flatten().tolist()
    standing = [f for f in faults if f.size in off]
    if not standing:
        return None
    window = state.window(start)
    found = isolate(
        observer, window, state.believed, standing, incipient=False, deepest=len(standing), healthy=state.healthy
    )
    own = next(f for f in found if f.hypothesis.columns)
    near = (own.value - state.healthy).abs() <= 3.0 * own.std
    apart = (own.value - state.believed).abs() > 3.0 * own.std
    if own.hypothesis.gone or any(bool((near & apart)[c]) for c in own.hypothesis.sizes):
        return None  # one of them went away
    own = replace(own, value=torch.where(near, state.believed, own.value))
    if _share(observer, window, state, own) > SLIGHT:
        return None
    others = [f for f in faults if f.size not in off]
    if others:
        best = isolate(observer, window, state.believed, others, incipient=False, deepest=1)[0]
        if (own.misfit - best.misfit) / best.rest > CLEARLY:
            return None
    return own


def _share(observer: ChangedObserver, window: Window, state: MonitorState, change: Finding) -> float:
    """The effect of a change of the standing faults over those of the faults themselves, since its onset."""
    theta = torch.cat([change.value[None], state.without_each(observer)])
    sudden = torch.zeros(len(theta), dtype=torch.bool)
    lanes = Changes(theta, torch.full((len(theta),), change.onset, dtype=theta.dtype), sudden)
    base = observer.white(window, state.believed, unchanged(state.believed))
    moved, *gone = (observer.white(window, state.believed, lanes) - base).square().sum((1, 2)).tolist()
    return (moved / sum(gone)) ** 0.5 if sum(gone) > 0.0 else float("inf")


def tracked(
    state: MonitorState, change: Change, sizes: Sequence[int], strength: Callable[[int], float]
) -> MonitorState:
    """With a track for each fault that stands after a change; sizes: the columns that say how much."""
    found, tracks = change.finding, []
    for column in sizes:
        if float(state.believed[column]) == float(state.healthy[column]):
            continue
        earlier = next((t for t in state.tracks if t.column == column), None)
        if column not in found.hypothesis.columns:
            tracks += [earlier] if earlier else []
            continue
        now = state.now, float(state.believed[column]), float(found.std[column])
        if earlier is not None and earlier.number == change.number:
            start = (found.onset, float(change.before[column]), 0.0) if found.hypothesis.incipient else earlier.first
            tracks.append(replace(earlier, onset=found.onset, first=start, last=now, strength=strength(column)))
            continue
        start = (found.onset, float(change.before[column]), 0.0) if found.hypothesis.incipient else now
        tracks.append(Track(column, change.number, found.onset, start, now, strength(column), state.now))
    return replace(state, tracks=tuple(tracks))


def resized(state: MonitorState, finding: Finding, revise: float) -> tuple[MonitorState, list[Track]]:
    """With the new sizes of faults that stand; which of them are due to be said aloud again: those that have stood
    `revise` times as long as when they were last.
    """
    tracks, due = [], []
    for t in state.tracks:
        if t.column in finding.hypothesis.columns:
            size, std = float(finding.value[t.column]), float(finding.std[t.column])
            t = replace(t, last=(state.now, size, std), adjusted=finding.onset)
            if state.now - t.onset >= revise * (t.announced - t.onset):
                t = replace(t, announced=state.now)
                due.append(t)
        tracks.append(t)
    return replace(state, tracks=tuple(tracks)), due
