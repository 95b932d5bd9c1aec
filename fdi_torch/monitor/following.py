"""What a monitor carries from sample to sample, and the observer that moves it on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.monitor.change import ChangedObserver, Changes, Window, unchanged
from fdi_torch.monitor.continuity import joined
from fdi_torch.monitor.isolation import Finding
from fdi_torch.monitor.samples import Samples


@dataclass(frozen=True)
class Change:
    """A change that was found: the belief before it, the finding, when the alarm came and when to look again."""

    before: Tensor
    finding: Finding
    alarm: float
    next_look: float


@dataclass(frozen=True)
class MonitorState:
    """All that a monitor carries from sample to sample.

    samples: what came lately; for each, state (S, tanks + M) of the observer after it, residual and white (S, sensors).
    watched: how many of them the detector no longer looks at. number: samples since the observer's start. believed
    (P,). reachable: no window starts before it, s. alarm: one that is being looked into, s; looks: how often it was, in
    vain. change: the latest.
    """

    samples: Samples
    state: Tensor
    residual: Tensor
    white: Tensor
    watched: int
    number: int
    believed: Tensor
    reachable: float
    alarm: float | None = None
    looks: int = 0
    change: Change | None = None

    @property
    def now(self) -> float:
        """When the last sample came, s."""
        return float(self.samples.time[-1])

    def before(self, moment: float) -> int:
        """The last sample before a moment, so that at least two follow; the first where there is none."""
        return max(min(int((self.samples.time < moment).sum()) - 1, len(self.samples) - 3), 0)

    def window(self, start: float) -> Window:
        """From the last sample before `start` on."""
        first = self.before(start)
        seen = self.number - (len(self.samples) - 1 - first)
        return Window(self.samples.stretch(first, len(self.samples)), self.state[first], seen)


def begin(observer: ChangedObserver, first: Samples, believed: Tensor, levels: Tensor | None = None) -> MonitorState:
    """The state after one sample; levels (tanks,) from the readings where not given."""
    state, residual = observer.first_state(first, believed, levels)
    white = observer.whitening(residual[None])
    return MonitorState(first, state[None], residual[None], white, 0, 1, believed, float(first.time[0]))


def observe(observer: ChangedObserver, state: MonitorState, samples: Samples) -> MonitorState:
    """The observer moved on by some samples."""
    last = len(state.samples) - 1
    window = Window(joined(state.samples.stretch(last, last + 1), samples), state.state[-1], state.number)
    path, residual = observer.follow(window, state.believed, unchanged(state.believed))
    moved = replace(
        state,
        samples=joined(state.samples, samples),
        state=torch.cat([state.state, path[0]]),
        residual=torch.cat([state.residual, residual[0]]),
        number=state.number + len(samples),
    )
    return _whitened(observer, moved, len(state.samples))


def believe(observer: ChangedObserver, state: MonitorState, change: Change, believed: Tensor) -> MonitorState:
    """The observer run again from the change's onset with the new values; the detector starts afresh."""
    finding = change.finding
    window = state.window(finding.onset)
    first = len(state.samples) - len(window)
    came = Changes(believed[None], believed.new_tensor([finding.onset]), torch.tensor([finding.hypothesis.incipient]))
    path, residual = observer.follow(window, change.before, came)
    moved = replace(
        state,
        believed=believed,
        state=torch.cat([state.state[:first], path[0]]),
        residual=torch.cat([state.residual[:first], residual[0]]),
        watched=len(state.samples),
        alarm=None,
        looks=0,
        change=change,
    )
    return _whitened(observer, moved, first)


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
        watched=state.watched - first,
    )


def _whitened(observer: ChangedObserver, state: MonitorState, first: int) -> MonitorState:
    """White residuals from sample `first` on, made anew from the residuals before and after it."""
    history = max(first - observer.whitening.order, 0)
    white = observer.whitening(state.residual[history:])[first - history :]
    return replace(state, white=torch.cat([state.white[:first], white]))
