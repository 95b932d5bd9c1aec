"""The monitor: observer, alarm, isolation and sizes along a recording, each change fed back into the observer.

The 2020 paper's adaptive observer (16): the newest parameters go back into the observer. Here they are found from the
white innovations, together with the moment of change.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.monitor.change import ChangedObserver
from fdi_torch.monitor.continuity import continuous
from fdi_torch.monitor.detection import Detector
from fdi_torch.monitor.events import Event, Kind
from fdi_torch.monitor.following import Change, MonitorState, adjust, begin, believe, forget, observe
from fdi_torch.monitor.hypothesis import Fault, Finding
from fdi_torch.monitor.isolation import isolate, refit
from fdi_torch.monitor.noise import Noise
from fdi_torch.monitor.samples import Samples
from fdi_torch.monitor.settings import MonitorSettings
from fdi_torch.monitor.standing import CLEARLY, held_since, slight_change, trusted
from fdi_torch.monitor.telling import rivals_of, tell, with_nominals
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork

SHAPE = ("period", "phase")
MOST_AT_ONCE = 512  # samples that the observer is run along before the detector looks at them


@dataclass(frozen=True)
class Seen:
    """time (S,) s, residual (S, sensors) in the readings' units, statistic (S,) that is held against the threshold."""

    time: Tensor
    residual: Tensor
    statistic: Tensor


class Monitor:
    """Follows one plant. The first `watched` parameters of `space` (all by default) may change, the others are only
    believed. State in, state out: `advance`. What is found does not depend on how many samples come at once.
    """

    def __init__(
        self,
        network: TankNetwork,
        space: ParameterSpace,
        noise: Noise,
        detector: Detector,
        settings: MonitorSettings | None = None,
        longest_step: float | None = None,
        watched: int | None = None,
    ) -> None:
        if not len(space):
            raise ValueError("expected at least one fault to watch for, got none; name some")
        self.network, self.space, self.noise, self.detector = network, space, noise, detector
        self.settings = settings or MonitorSettings()
        self.watched = len(space) if watched is None else watched
        self.faults = faults_of(space.names[: self.watched])
        self.observer = ChangedObserver(network, space, noise.gain, noise.whitening, longest_step)

    def start(self, samples: Samples, believed: Tensor | None = None, levels: Tensor | None = None) -> MonitorState:
        """The state after the first of some samples."""
        theta = self.space.nominal() if believed is None else believed
        return begin(self.observer, samples, theta, self._healthy(theta), levels)

    def advance(
        self, state: MonitorState, samples: Samples, show: Callable[[Seen], None] | None = None
    ) -> tuple[MonitorState, list[Event]]:
        """Takes the samples that have come since, in order; their clock may jump and readings or inputs may lack.

        show is handed what the observer and the detector saw, sample by sample in order.
        """
        events: list[Event] = []
        for stretch, notice in continuous(state.samples, samples):
            if notice:
                events.append(Event(float(stretch.time[0]), "notice", notice))
                state = begin(self.observer, stretch, state.believed, state.healthy)
                stretch = stretch.stretch(1, len(stretch))
            while len(stretch):
                state, taken, news = self._take(state, stretch, show)
                events += news
                stretch = stretch.stretch(taken, len(stretch))
        return state, events

    def _healthy(self, believed: Tensor) -> Tensor:
        """What is believed, without any fault."""
        healthy = believed.clone()
        healthy[: self.watched] = self.space.nominal()[: self.watched]
        return healthy

    def _take(
        self, state: MonitorState, samples: Samples, show: Callable[[Seen], None] | None
    ) -> tuple[MonitorState, int, list[Event]]:
        """As many samples as can be taken before something is to be done, and what then comes of it."""
        due = samples.time >= self._next_look(state)
        count = int(due.to(torch.int8).argmax()) + 1 if bool(due.any()) else len(samples)
        count = min(count, MOST_AT_ONCE)
        before, moved = state, observe(self.observer, state, samples.stretch(0, count))
        statistic = self._statistic(moved, count)
        above = statistic > self.detector.threshold
        raised = state.alarm is None and bool(above.any())
        if raised:
            count = int(above.to(torch.int8).argmax()) + 1
            moved = observe(self.observer, before, samples.stretch(0, count))
        if show is not None:
            show(Seen(moved.samples.time[-count:], moved.residual[-count:], statistic[:count]))
        state, events = self._alarm(moved) if raised else (moved, [])
        if not raised and state.now >= self._next_look(state):
            state, events = self._look(state)
        return self._forgotten(state), count, events

    def _statistic(self, state: MonitorState, fresh: int) -> Tensor:
        """The detector's statistic at the last `fresh` samples, (fresh,)."""
        first = max(state.watched, len(state.samples) - fresh - self.detector.memory)
        return self.detector.statistic(trusted(self.observer, state)[first:])[-fresh:]

    def _alarm(self, state: MonitorState) -> tuple[MonitorState, list[Event]]:
        """An alarm; or only better sizes, where those of the last change explain the residual."""
        if state.change is not None and self._within_window(state, state.change):
            window = state.window(self._look_back(state, state.change))
            same = refit(self.observer, window, state.change.before, [state.change.finding])
            if same[0].fits:
                due = state.change.next_look  # names are looked at again no later for it
                revised, events = self._revise(state, state.change, "revised", same)
                assert revised.change is not None
                sooner = min(due, revised.change.next_look)
                return replace(revised, change=replace(revised.change, next_look=sooner)), events
        slight = slight_change(self.observer, state, self._reach(state, state.now), self.faults)
        if slight is not None:
            return adjust(self.observer, state, slight), []
        alarm = Event(state.now, "alarm", "the residual leaves its fault-free range")
        return replace(state, alarm=state.now, looks=0), [alarm]

    def _reach(self, state: MonitorState, alarm: float) -> float:
        """Since when a change that raised an alarm may be: not before the last one."""
        return max(alarm - self.settings.lookback, held_since(state))

    def _next_look(self, state: MonitorState) -> float:
        if state.alarm is not None:
            return state.alarm + self.settings.confirm * self.settings.revise**state.looks
        return state.change.next_look if state.change is not None else float("inf")

    def _forgotten(self, state: MonitorState) -> MonitorState:
        return forget(state, self.settings.longest + self.settings.lookback)

    def _look(self, state: MonitorState) -> tuple[MonitorState, list[Event]]:
        """Tells faults apart after an alarm, or estimates their sizes again."""
        change = state.change
        if state.alarm is None:
            assert change is not None
            return self._reconsider(state, change)
        if change is not None and self._within_window(state, change):
            # Was the last change only taken for the wrong one? One change explaining all is preferred to two.
            found = self._explanations(state, self._look_back(state, change), change.before, change.finding)
            if found[0].fits:
                return self._revise(state, change, "isolated", found)
        return self._isolate(state)

    def _reconsider(self, state: MonitorState, change: Change) -> tuple[MonitorState, list[Event]]:
        """The last change estimated again, or named anew; if nothing explains all, only for a clearly better name."""
        if not self._within_window(state, change):
            return replace(state, change=replace(change, next_look=float("inf"))), []
        found = self._explanations(state, self._look_back(state, change), change.before, change.finding)
        same = [f for f in found if f.hypothesis == change.finding.hypothesis]
        followed = state.adjusted > change.finding.onset  # its sizes have been: no single change is what happened
        close = followed or (same and same[0].score - found[0].score < CLEARLY)
        if not found[0].fits and close:
            later = self._look_again(change.finding, state.now)
            return replace(state, change=replace(change, next_look=later)), []
        return self._revise(state, change, "revised", found)

    def _isolate(self, state: MonitorState) -> tuple[MonitorState, list[Event]]:
        assert state.alarm is not None
        found = self._explanations(state, self._reach(state, state.alarm), state.believed)
        if found[0].score >= 0.0:
            return self._unexplained(state)
        change = Change(state.believed, held_since(state), found[0], state.alarm, self._look_again(found[0], state.now))
        return self._believe(state, change), self._tell(state, change, found, "isolated")

    def _unexplained(self, state: MonitorState) -> tuple[MonitorState, list[Event]]:
        """Said once; looked at again when more has been seen, until the longest window is full."""
        text = "no fault of the list explains the alarm better than noise does"
        events = [] if state.looks else [Event(state.now, "unexplained", text)]
        waiting = replace(state, looks=state.looks + 1)
        if self._next_look(waiting) - (state.alarm or 0.0) <= self.settings.longest:
            return waiting, events
        return replace(state, alarm=None, looks=0, watched=len(state.samples)), events

    def _revise(
        self, state: MonitorState, change: Change, kind: Kind, found: Sequence[Finding]
    ) -> tuple[MonitorState, list[Event]]:
        """The last change as the best of some findings has it."""
        finding = found[0]
        alarm = change.alarm if state.alarm is None or change.alarm > finding.onset - 1.0 else state.alarm
        revised = replace(change, finding=finding, alarm=alarm, next_look=self._look_again(finding, state.now))
        news = self._tell(state, revised, found, kind)
        if finding.hypothesis == change.finding.hypothesis and state.alarm is None:
            news = [event for event in news if event.kind != "recovered"]  # it has been told
        return self._believe(state, revised), news

    def _look_back(self, state: MonitorState, change: Change) -> float:
        """Since when the last change may be, when it is looked at again."""
        return max(change.finding.onset - self.settings.lookback, change.since, state.reachable)

    def _within_window(self, state: MonitorState, change: Change) -> bool:
        return state.now - change.finding.onset <= self.settings.longest and change.finding.onset >= state.reachable

    def _look_again(self, finding: Finding, now: float) -> float:
        since = max(now - finding.onset, self.settings.confirm, 1.0)
        return finding.onset + self.settings.revise * since

    def _explanations(
        self, state: MonitorState, start: float, believed: Tensor, known: Finding | None = None
    ) -> list[Finding]:
        """Of what came since `start`, best first. known: what was found of it before."""
        s, healthy, window = self.settings, self._healthy(believed), state.window(start)
        return isolate(self.observer, window, believed, self.faults, s.incipient, s.together, healthy, known)

    def _believe(self, state: MonitorState, change: Change) -> MonitorState:
        """Feeds the newest parameters back."""
        return believe(self.observer, state, change, with_nominals(self.space, change))

    def _tell(self, state: MonitorState, change: Change, found: Sequence[Finding], kind: Kind) -> list[Event]:
        return tell(self.space, change, rivals_of(self.space, found), state.now, kind, state.reachable)


def faults_of(names: Sequence[str]) -> list[Fault]:
    """The faults that parameters make up: an oscillation's period and phase belong to its amplitude."""
    faults = []
    for column, name in enumerate(names):
        effect, _, field = name.rpartition(".")
        if field not in SHAPE:
            shape = tuple(names.index(f"{effect}.{s}") for s in SHAPE if f"{effect}.{s}" in names)
            faults.append(Fault(column, shape))
    return faults
