"""What a monitor carries from sample to sample, and the observer that moves it on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.monitor.change import LONG_AGO, NEVER, ChangedObserver, Changes, Window
from fdi_torch.monitor.continuity import joined
from fdi_torch.monitor.hypothesis import Finding
from fdi_torch.monitor.samples import Samples


@dataclass(frozen=True)
class Change:
    """A change that was found: the belief before it and since when that is held (s), the finding, when the alarm came
    and when to look again.
    """

    before: Tensor
    since: float
    finding: Finding
    alarm: float
    next_look: float


@dataclass(frozen=True)
class MonitorState:
    """All that a monitor carries from sample to sample.

    samples: what came lately; for each, state (S, tanks + M) of the observer after it, residual and white (S, sensors),
    and effect (S, E, sensors): by how much the residual would be another without each of the effects believed in.
    watched: how many of them the detector no longer looks at. number: samples since the observer's start. believed
    (P,); healthy (P,): the same without a fault. blind (E, tanks + M): the states of observers without each effect.
    reachable: no window starts before it, s. rest (sensors,): white residuals that are the believed faults' own, in
    standard deviations of noise, where they do not explain all. alarm: one that is being looked into, s; looks: how
    often it was, in vain. change: the latest. adjusted: since when sizes other than it says are believed in, s.
    """

    samples: Samples
    state: Tensor
    residual: Tensor
    white: Tensor
    effect: Tensor
    watched: int
    number: int
    believed: Tensor
    healthy: Tensor
    blind: Tensor
    reachable: float
    rest: Tensor
    alarm: float | None = None
    looks: int = 0
    change: Change | None = None
    adjusted: float = LONG_AGO

    @property
    def now(self) -> float:
        """When the last sample came, s."""
        return float(self.samples.time[-1])

    def standing(self, observer: ChangedObserver) -> list[int]:
        """Which of the space's effects are believed in as faults."""
        off = (self.believed != self.healthy).tolist()
        return [e for e, columns in enumerate(observer.effects) if any(off[c] for c in columns)]

    def without_each(self, observer: ChangedObserver) -> Tensor:
        """What is believed, each time without one of the faults that stand, (standing, P)."""
        standing = self.standing(observer)
        theta = self.believed.repeat(len(standing), 1)
        for lane, e in enumerate(standing):
            theta[lane, list(observer.effects[e])] = self.healthy[list(observer.effects[e])]
        return theta

    def before(self, moment: float) -> int:
        """The last sample before a moment, so that at least two follow; the first where there is none."""
        return max(min(int((self.samples.time < moment).sum()) - 1, len(self.samples) - 3), 0)

    def window(self, start: float) -> Window:
        """From the last sample before `start` on."""
        first = self.before(start)
        seen = self.number - (len(self.samples) - 1 - first)
        return Window(self.samples.stretch(first, len(self.samples)), self.state[first], seen)


def begin(
    observer: ChangedObserver, samples: Samples, believed: Tensor, healthy: Tensor, levels: Tensor | None = None
) -> MonitorState:
    """The state after the first of some samples; levels (tanks,) from the readings where not given."""
    first = samples.stretch(0, 1)
    state, residual = observer.first_state(samples, believed, levels)
    white, effects = observer.whitening(residual[None]), len(observer.effects)
    blind, none = state.expand(effects, -1), torch.zeros_like(residual)
    effect = none.expand(1, effects, -1)
    return MonitorState(
        first, state[None], residual[None], white, effect, 0, 1, believed, healthy, blind, float(first.time[0]), none
    )


def observe(observer: ChangedObserver, state: MonitorState, samples: Samples) -> MonitorState:
    """The observer moved on by some samples."""
    last = len(state.samples) - 1
    window = Window(joined(state.samples.stretch(last, last + 1), samples), state.state[-1], state.number)
    state = replace(state, samples=joined(state.samples, samples), number=state.number + len(samples))
    return _run(observer, state, window, state.blind, state.believed, NEVER)


def believe(observer: ChangedObserver, state: MonitorState, change: Change, believed: Tensor) -> MonitorState:
    """The observer run again from the change's onset with the new values (P,); the detector starts afresh."""
    finding = change.finding
    window = state.window(finding.onset)
    incipient, standing = finding.hypothesis.incipient, state.standing(observer)
    state = replace(state, believed=believed, change=change, adjusted=LONG_AGO, alarm=None, looks=0)
    moved = _run(observer, state, window, _alike(observer, window), change.before, finding.onset, incipient)
    left = moved.white[-len(window) :].square().nanmean(dim=0).nan_to_num().sqrt()
    if finding.fits or not moved.standing(observer):
        left = torch.zeros_like(left)
    elif set(state.standing(observer)) >= set(standing):
        left = torch.maximum(left, state.rest)  # nothing went away: what was left before may come back
    return replace(moved, rest=left, watched=len(moved.samples))


def adjust(observer: ChangedObserver, state: MonitorState, finding: Finding) -> MonitorState:
    """The observer run again with other sizes of the faults that it believes in."""
    window, before = state.window(finding.onset), state.believed
    moved = replace(state, believed=finding.value, adjusted=finding.onset, watched=len(state.samples))
    return _run(observer, moved, window, _alike(observer, window), before, finding.onset)


def forget(state: MonitorState, reach: float) -> MonitorState:
    """Without what lies more than `reach` s back, once that is a quarter of all."""
    oldest = state.now if state.alarm is None else min(state.now, state.alarm)
    first = min(int((state.samples.time < oldest - reach).sum()), state.watched)
    if first < 0.25 * len(state.samples):
        return state
    return replace(
        state,
        samples=state.samples.stretch(first, len(state.samples)),
        state=state.state[first:],
        residual=state.residual[first:],
        white=state.white[first:],
        effect=state.effect[first:],
        watched=state.watched - first,
    )


def _run(
    observer: ChangedObserver,
    state: MonitorState,
    window: Window,
    blind: Tensor,
    before: Tensor,
    onset: float,
    incipient: bool = False,
) -> MonitorState:
    """The state with its last samples, those of a window, run (again): from the belief `before` to the one held now.

    blind (E, tanks + M): at the window's start, of observers without one of the effects that are believed in, which run
    beside it.
    """
    first, standing = len(state.samples) - len(window), state.standing(observer)
    theta = torch.cat([state.believed[None], state.without_each(observer)])
    onsets = before.new_tensor([onset, *[LONG_AGO] * len(standing)])
    changes = Changes(theta, onsets, torch.tensor([incipient, *[False] * len(standing)]))
    starts = torch.cat([window.state[None], blind[standing]])
    path, residual = observer.follow(replace(window, state=starts), before, changes)
    effect = residual.new_zeros(len(window), len(observer.effects), residual.shape[-1])
    effect[:, standing] = (residual[1:] - residual[0]).movedim(0, 1).nan_to_num()
    last = path[0, -1].repeat(len(observer.effects), 1)
    last[standing] = path[1:, -1]
    moved = replace(
        state,
        state=torch.cat([state.state[:first], path[0]]),
        residual=torch.cat([state.residual[:first], residual[0]]),
        effect=torch.cat([state.effect[:first], effect]),
        blind=last,
    )
    return _whitened(observer, moved, first)


def _alike(observer: ChangedObserver, window: Window) -> Tensor:
    """Observers without one effect that begin where the one with all of them is, (E, tanks + M)."""
    return window.state.expand(len(observer.effects), -1)


def _whitened(observer: ChangedObserver, state: MonitorState, first: int) -> MonitorState:
    """White residuals from sample `first` on, made anew from the residuals before and after it."""
    history = max(first - observer.whitening.order, 0)
    white = observer.whitening(state.residual[history:])[first - history :]
    return replace(state, white=torch.cat([state.white[:first], white]))
