"""Faults that stand: followed as they change slightly, and trusted no further than their laws go."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from fdi_torch.monitor.change import ChangedObserver, Changes, Window, unchanged
from fdi_torch.monitor.following import MonitorState
from fdi_torch.monitor.hypothesis import Fault, Finding
from fdi_torch.monitor.isolation import isolate

# A believed fault's law may be off by so much of its own effect (a hole is not the orifice of a formula).
OFF = 0.1
# A change by less than this share of the effect of the faults that stand is theirs, and no event.
SLIGHT = 1.0 / 3.0
# By how much another fault must explain such a change better, in units of BIC: "very strong" (Kass & Raftery 1995).
CLEARLY = 10.0


def trusted(observer: ChangedObserver, state: MonitorState) -> Tensor:
    """White residuals (S, sensors) in standard deviations of noise and of the believed faults' own imperfection:
    e / sqrt(max(1, rest)^2 + sum (OFF f)^2), with f what each of them takes out of the residual at that moment, and
    rest what they left in it when they were found.
    """
    standing = state.standing(observer)
    if not standing:
        return state.white
    effects = observer.whitening.filter(state.effect[:, standing].movedim(1, 0))
    return state.white / torch.sqrt(state.rest.clamp(min=1.0) ** 2 + (OFF * effects).square().sum(0))


def held_since(state: MonitorState) -> float:
    """Since when what is believed now is believed, s."""
    last = state.change.finding.onset if state.change is not None else state.reachable
    return max(state.reachable, last, state.adjusted)


def slight_change(
    observer: ChangedObserver, state: MonitorState, start: float, faults: Sequence[Fault]
) -> Finding | None:
    """New sizes, since `start` or later, of the faults that stand, where they change slightly and no other fault says
    more of it; None where nothing stands, or something else happens.
    """
    off = (state.believed != state.healthy).nonzero().flatten().tolist()
    standing = [f for f in faults if f.size in off]
    if not standing:
        return None
    window = state.window(start)
    own = isolate(
        observer, window, state.believed, standing, incipient=False, deepest=len(standing), healthy=state.healthy
    )[0]
    near = (own.value - state.healthy).abs() <= 3.0 * own.std
    apart = (own.value - state.believed).abs() > 3.0 * own.std
    if own.score >= 0.0 or any(bool((near & apart)[c]) for c in own.hypothesis.sizes):
        return None  # nothing of theirs, or one of them went away
    own = replace(own, value=torch.where(near, state.believed, own.value))
    if _share(observer, window, state, own) > SLIGHT:
        return None
    others = [f for f in faults if f.size not in off]
    if others:
        best = isolate(observer, window, state.believed, others, incipient=False, deepest=1)[0]
        if best.misfit < own.misfit and 2.0 * (own.misfit - best.misfit) / _rest(best) > CLEARLY:
            return None
    return own


def _rest(finding: Finding) -> float:
    """What it leaves, as a multiple of noise."""
    return max(2.0 * finding.misfit / finding.readings, 1.0)


def _share(observer: ChangedObserver, window: Window, state: MonitorState, change: Finding) -> float:
    """The effect of a change of the standing faults over those of the faults themselves, since its onset."""
    theta = torch.cat([change.value[None], state.without_each(observer)])
    sudden = torch.zeros(len(theta), dtype=torch.bool)
    lanes = Changes(theta, torch.full((len(theta),), change.onset, dtype=theta.dtype), sudden)
    base = observer.white(window, state.believed, unchanged(state.believed))
    moved, *gone = (observer.white(window, state.believed, lanes) - base).square().sum((1, 2)).tolist()
    return (moved / sum(gone)) ** 0.5 if sum(gone) > 0.0 else float("inf")
