"""The monitor: observer, alarm, isolation and sizes along a recording, each change fed back into the observer.

The 2020 paper's adaptive observer (16): the newest parameters go back into the observer. Here they are found from the
white innovations, together with the moment of change. What is said at a moment rests on the readings until then alone,
and does not depend on how many samples come at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.monitor.change import LONG_AGO, ChangedObserver
from fdi_torch.monitor.detection import Detector
from fdi_torch.monitor.events import Event, Kind
from fdi_torch.monitor.following import (
    Change,
    Looking,
    MonitorState,
    adjust,
    begin,
    believe,
    forget,
    observe,
    strength,
    trusted,
)
from fdi_torch.monitor.hypothesis import Fault, Finding, content, distinct
from fdi_torch.monitor.isolation import isolate, refit
from fdi_torch.monitor.noise import Noise
from fdi_torch.monitor.recovery import gone_columns, is_observable, with_nominals
from fdi_torch.monitor.samples import Samples, continuous
from fdi_torch.monitor.settings import MonitorSettings
from fdi_torch.monitor.standing import CLEARLY, changed_size, resized, tracked
from fdi_torch.monitor.states import Alarm, State
from fdi_torch.monitor.telling import Teller
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork

SHAPE = ("period", "phase")
MOST_AT_ONCE = 512  # samples that the observer is run along before the detector looks at them
GROWING = 8.0  # longest windows over which a fault that grows is followed by one straight line
KEPT = 1e-3  # of the posterior: explanations with less are not fitted again


@dataclass(frozen=True)
class Seen:
    """time (S,) s, residual (S, sensors) in the readings' units, statistic (S,) that is held against the threshold."""

    time: Tensor
    residual: Tensor
    statistic: Tensor


class Monitor:
    """Follows one plant. The first `watched` parameters of `space` (all by default) may change, the others are only
    believed. State in, state out: `advance`.
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
        self.choices = len(self.faults) * (2 if self.settings.incipient else 1)
        self.observer = ChangedObserver(network, space, noise.gain, noise.whitening, longest_step)
        self.teller = Teller(self.observer, noise, self.settings, self.watched)

    def start(
        self,
        samples: Samples,
        believed: Tensor | None = None,
        levels: Tensor | None = None,
        learning_until: float = LONG_AGO,
    ) -> MonitorState:
        """The state after the first of some samples. learning_until: end of the part that noise was learnt from, s.

        Up to then the monitor knows its own noise from readings yet to come, so that it raises no alarm.
        """
        theta = self.space.nominal() if believed is None else believed
        return replace(
            begin(self.observer, samples, theta, self._healthy(theta), levels), learning_until=learning_until
        )

    def advance(
        self, state: MonitorState, samples: Samples, show: Callable[[Seen], None] | None = None
    ) -> tuple[MonitorState, list[Event]]:
        """Takes the samples that have come since, in order; their clock may jump and readings or inputs may lack.

        show is handed what the observer and the detector saw, sample by sample in order.
        """
        events: list[Event] = []
        stretches, arrived = continuous(state.arrived, samples, self.noise.interval)
        for stretch, notice in stretches:
            if notice:
                state, news = self._restart(state, stretch, notice)
                events += news
                stretch = stretch.stretch(1, len(stretch))
            while len(stretch):
                state, taken, news = self._take(state, stretch, show)
                events += news
                stretch = stretch.stretch(taken, len(stretch))
        return replace(state, arrived=arrived), events

    def close(self, state: MonitorState) -> list[Event]:
        """One line for each alarm, at the end."""
        return [self.teller.summary(state, alarm) for alarm in state.alarms]

    def _healthy(self, believed: Tensor) -> Tensor:
        """What is believed, without any fault."""
        healthy = believed.clone()
        healthy[: self.watched] = self.space.nominal()[: self.watched]
        return healthy

    def _restart(self, state: MonitorState, samples: Samples, notice: str) -> tuple[MonitorState, list[Event]]:
        """After a gap the observer starts afresh; faults that stand are believed in as before."""
        fresh = begin(self.observer, samples, state.believed, state.healthy)
        fresh = replace(
            fresh,
            alarms=state.alarms,
            tracks=state.tracks,
            rest=state.rest,
            looking=state.looking,
            learning_until=state.learning_until,
        )
        events = [self.teller.notice(fresh, notice)]
        if state.looking is not None:
            fresh, event = self._retire(fresh, state.looking.number, "the samples that would explain it are missing")
            events.append(event)
        return fresh, events

    def _take(
        self, state: MonitorState, samples: Samples, show: Callable[[Seen], None] | None
    ) -> tuple[MonitorState, int, list[Event]]:
        """As many samples as can be taken before something is to be done, and what then comes of it."""
        learning = state.learning_until > LONG_AGO
        due = samples.time >= (state.learning_until if learning else self._next_look(state))
        count = int(due.to(torch.int8).argmax()) + 1 if bool(due.any()) else len(samples)
        count = min(count, MOST_AT_ONCE)
        moved, statistic = self._observed(state, samples.stretch(0, count))
        above = statistic > self.detector.threshold
        raised = state.looking is None and not learning and bool(above.any())
        if raised:
            count = int(above.to(torch.int8).argmax()) + 1
            moved, statistic = self._observed(state, samples.stretch(0, count))
        if show is not None:
            show(Seen(moved.samples.time[-count:], moved.residual[-count:], statistic))
        moved = replace(moved, floor=max(moved.floor, self._floor(moved)))
        if learning:
            ended = moved.now >= state.learning_until
            return forget(replace(moved, learning_until=LONG_AGO, charted=None) if ended else moved), count, []
        state, events = self._alarm(moved) if raised else (moved, [])
        if not raised and state.now >= self._next_look(state):
            state, events = self._look(state)
        return forget(state), count, events

    def _floor(self, state: MonitorState) -> float:
        """The earliest moment that may still be asked for, s."""
        raised = state.now if state.looking is None else state.alarm(state.looking.number).last
        usual, change = raised - self.settings.longest - self.settings.lookback, state.change
        if change is None or not change.finding.hypothesis.incipient or not self._within_window(state, change):
            return usual
        return min(usual, change.finding.onset - self.settings.lookback)

    def _observed(self, state: MonitorState, samples: Samples) -> tuple[MonitorState, Tensor]:
        """The state some samples later, and the detector's statistic (S,) at each of them."""
        moved = observe(self.observer, state, samples)
        fresh = trusted(self.observer, moved, len(samples))
        statistic, charted = self.detector.follow(fresh, state.charted)
        return replace(moved, charted=charted), statistic

    def _next_look(self, state: MonitorState) -> float:
        if state.looking is not None:
            raised = state.alarm(state.looking.number).last
            return raised + self.settings.confirm * self.settings.revise**state.looking.looks
        return state.change.next_look if state.change is not None else float("inf")

    def _alarm(self, state: MonitorState) -> tuple[MonitorState, list[Event]]:
        """An alarm; or only better sizes, where the last change still explains it or a fault that stands changes."""
        change = state.change
        if change is not None and self._within_window(state, change):
            window = state.window(self._look_back(state, change))
            same = refit(self.observer, window, change.before, change.explanations, self.choices)
            if same[0].fits and same[0].hypothesis.columns:
                due = change.next_look  # names are looked at again no later for it
                state = state.with_alarm(state.alarm(change.number).again(state.now))
                revised, events = self._revise(state, change, "revised", same, aloud=False)
                assert revised.change is not None
                sooner = min(due, revised.change.next_look)
                return replace(revised, change=replace(revised.change, next_look=sooner)), events
        other = changed_size(self.observer, state, self._reach(state, state.now), self.faults, self.choices)
        if other is not None:
            moved, again = resized(adjust(self.observer, state, other), other, self.settings.revise)
            sized = [t for t in moved.tracks if t.column in other.hypothesis.columns]
            return moved, self.teller.followed(moved, sized, again)
        alarm = Alarm(len(state.alarms) + 1, state.now, state.now, self._shares(state))
        raised = replace(state, alarms=(*state.alarms, alarm), looking=Looking(alarm.number))
        return raised, [self.teller.raised(raised, alarm)]

    def _shares(self, state: MonitorState) -> tuple[tuple[str, float], ...]:
        since = max(self._reach(state, state.now), state.now - self.settings.lookback)
        white = trusted(self.observer, state, max(int((state.samples.time > since).sum()), 1))
        names = [sensor.name for sensor in self.network.description.sensors]
        return tuple(zip(names, self.detector.shares(white).tolist(), strict=True))

    def _reach(self, state: MonitorState, alarm: float) -> float:
        """Since when a change that raised an alarm may be: not before the last one."""
        return max(alarm - self.settings.lookback, self._held_since(state))

    def _look(self, state: MonitorState) -> tuple[MonitorState, list[Event]]:
        """Tells faults apart after an alarm, or fits all explanations again."""
        change = state.change
        if state.looking is None:
            assert change is not None
            return self._reconsider(state, change)
        if change is not None and self._within_window(state, change):
            # Was the last change only taken for the wrong one? One change explaining all is preferred to two.
            window, known = self._look_back(state, change), change.explanations
            found = self._explanations(state, window, change.before, known)
            if found[0].fits and found[0].hypothesis.columns:
                return self._same_change(state, change, found)
            if change.finding.at_end:
                return self._same_change(state, change, found)
        return self._isolate(state)

    def _same_change(
        self, state: MonitorState, change: Change, found: Sequence[Finding]
    ) -> tuple[MonitorState, list[Event]]:
        """The alarm that is being confirmed came of the change before it."""
        assert state.looking is not None
        own = state.alarm(state.looking.number)
        state, event = self._retire(state, own.number, f"it counts with alarm {change.number}", announced=False)
        state = state.with_alarm(state.alarm(change.number).again(own.last))
        if not found[0].hypothesis.columns:
            return replace(state, looking=None), [event]
        revised, events = self._revise(state, change, "isolated", found)
        return revised, [event, *events]

    def _reconsider(self, state: MonitorState, change: Change) -> tuple[MonitorState, list[Event]]:
        """All explanations of the last change fitted again; if none explains all, only for a clearly better name."""
        if not self._within_window(state, change):
            return replace(state, change=replace(change, next_look=float("inf"))), []
        found = self._explanations(state, self._look_back(state, change), change.before, change.explanations)
        best, kept = found[0], [f for f in found if f.hypothesis.columns == change.finding.hypothesis.columns]
        followed = state.adjusted > change.finding.onset  # its sizes have been: no single change is what happened
        close = followed or not best.hypothesis.columns or (kept and best.evidence - kept[0].evidence < CLEARLY)
        if not best.fits and close:
            later = self._look_again(change.finding, state.now)
            return replace(state, change=replace(change, next_look=later)), []
        return self._revise(state, change, "revised", found)

    def _isolate(self, state: MonitorState) -> tuple[MonitorState, list[Event]]:
        assert state.looking is not None
        number = state.looking.number
        found = self._since_its_beginning(state, self._reach(state, state.alarm(number).last))
        if not found[0].hypothesis.columns:
            return self._unexplained(state, found)
        own = state.alarm(number)
        events: list[Event] = []
        owner = self._owner(state, found[0])
        if owner is not None:  # no new fault: one that stands has another size now
            state, event = self._retire(state, number, f"it counts with alarm {owner}", announced=False)
            events, number = [event], owner
            state = state.with_alarm(state.alarm(owner).again(own.last))
        held = self._held_since(state)
        change = Change(number, state.believed, held, tuple(found), own.last, self._look_again(found[0], state.now))
        state, news = self._answer(state, change, "isolated")
        return state, [*events, *news]

    def _since_its_beginning(self, state: MonitorState, start: float) -> list[Finding]:
        """Explanations of what came since `start`, or since twice or four times as long ago: where the best one begins
        with the window, it may have begun before.
        """
        earliest = max(self._held_since(state), state.floor)
        while True:
            found = self._explanations(state, start, state.believed)
            begins = found[0].onset - start <= 2.0 * found[0].onset_std and bool(found[0].hypothesis.columns)
            if not begins or start <= earliest:
                return found
            start = max(start - (state.now - start), earliest)

    def _held_since(self, state: MonitorState) -> float:
        """Since when what is believed now is believed, s."""
        last = state.change.finding.onset if state.change is not None else state.reachable
        return max(state.reachable, last, state.adjusted)

    def _owner(self, state: MonitorState, best: Finding) -> int | None:
        """The alarm of the faults that an explanation changes, where all of them stand and none goes away."""
        if best.hypothesis.gone:
            return None
        owners = {c: t.number for t in state.tracks for c in best.hypothesis.sizes if t.column == c}
        numbers = set(owners.values())
        return numbers.pop() if len(owners) == len(best.hypothesis.sizes) and len(numbers) == 1 else None

    def _unexplained(self, state: MonitorState, found: Sequence[Finding]) -> tuple[MonitorState, list[Event]]:
        """Said once; looked at again when more has been seen, until the longest window is full."""
        assert state.looking is not None
        number, looks = state.looking.number, state.looking.looks + 1
        waiting, events = replace(state, looking=Looking(number, looks)), []
        if looks == 1:
            waiting = waiting.with_alarm(waiting.alarm(number).to(State.CANNOT_TELL))
            events = [self.teller.unexplained(waiting, number, self._told(found))]
        if self._next_look(waiting) - state.alarm(number).last <= self.settings.longest:
            return waiting, events
        waiting, event = self._retire(waiting, number, "no fault of the list explains it better than chance does")
        return waiting, [*events, event]

    def _retire(
        self, state: MonitorState, number: int, reason: str, announced: bool = True
    ) -> tuple[MonitorState, Event]:
        retired = state.alarm(number).to(State.RETIRED)
        state = replace(state, looking=None, charted=None).with_alarm(retired)
        return state, self.teller.retired(state, retired, reason, announced)

    def _revise(
        self, state: MonitorState, change: Change, kind: Kind, found: Sequence[Finding], aloud: bool = True
    ) -> tuple[MonitorState, list[Event]]:
        """The last change as the posterior has it now."""
        alarm = change.alarm if change.alarm > found[0].onset - 1.0 else state.alarm(change.number).last
        again = self._look_again(found[0], state.now)
        revised = replace(change, explanations=tuple(found), alarm=alarm, next_look=again)
        return self._answer(state, revised, kind, aloud)

    def _answer(
        self, state: MonitorState, change: Change, kind: Kind, aloud: bool = True
    ) -> tuple[MonitorState, list[Event]]:
        """The change believed in, its alarm in the state that follows from the posterior, and what is said of it; not
        aloud where only sizes are better known.
        """
        told = self._told(change.explanations)
        best = told[0]
        kept = tuple(f for f in distinct(change.explanations) if f.hypothesis.columns and (f.mass > KEPT or f in told))
        change = replace(change, explanations=kept)
        back = gone_columns(self.space, change)
        ended = tuple(t for t in (change.ends or state.tracks) if t.column in back)
        observable = all(is_observable(self.observer, state, change, t) for t in ended)
        names = tuple(tuple(self.space.names[c] for c in f.hypothesis.columns) for f in told)
        aloud, change = aloud or names != change.told, replace(change, ends=ended, told=names)
        state = believe(self.observer, state, change, with_nominals(self.space, change, back))
        sized = [fault.size for fault in self.faults]
        state = tracked(state, change, sized, lambda c: strength(self.observer, state, c, change.finding.onset))
        state, events = self._ended(state, change, told, observable)
        rest = [c for c in best.hypothesis.sizes if c not in back]
        if not rest:
            numbers = [t.number for t in ended]
            if change.number not in numbers and state.alarm(change.number).state is not State.RETIRED:
                reason = f"it is the end of alarm {numbers[0]}" if numbers else "what changed is nominal"
                state, event = self._retire(state, change.number, reason, announced=False)
                events.append(event)
            return state, events
        alarm = state.alarm(change.number)
        answer = self._state_of(told)
        state = state.with_alarm(replace(alarm.to(answer), faults=tuple(self.space.names[c] for c in rest)))
        kind = kind if kind == "revised" and alarm.state is answer else str(answer)  # type: ignore[assignment]
        return state, [*events, self.teller.answered(state, change, told, kind, aloud or kind != "revised")]

    def _ended(
        self, state: MonitorState, change: Change, told: Sequence[Finding], observable: bool
    ) -> tuple[MonitorState, list[Event]]:
        """The alarms of faults that went away, or that the readings could no longer show."""
        answer, events = State.RECOVERED if observable else State.CANNOT_TELL, []
        for number in sorted({t.number for t in change.ends}):
            alarm = state.alarm(number)
            if alarm.state is not answer:
                state = state.with_alarm(alarm.to(answer))
                names = [self.space.names[t.column] for t in change.ends if t.number == number]
                events.append(self.teller.ended(state, change, told, number, names, observable))
        return state, events

    def _state_of(self, told: Sequence[Finding]) -> State:
        best = told[0]
        if best.at_end:
            return State.CANNOT_TELL
        return State.ISOLATED if len(told) == 1 and best.fits else State.EXPLAINED

    def _told(self, found: Sequence[Finding]) -> list[Finding]:
        return content(distinct(found), self.settings.level)

    def _look_back(self, state: MonitorState, change: Change) -> float:
        """Since when the last change may be, when it is looked at again."""
        return max(change.finding.onset - self.settings.lookback, change.since, state.reachable)

    def _within_window(self, state: MonitorState, change: Change) -> bool:
        longest = self.settings.longest * (GROWING if change.finding.hypothesis.incipient else 1.0)
        return state.now - change.finding.onset <= longest and change.finding.onset >= state.reachable

    def _look_again(self, finding: Finding, now: float) -> float:
        since = max(now - finding.onset, self.settings.confirm, 1.0)
        return finding.onset + self.settings.revise * since

    def _explanations(
        self, state: MonitorState, start: float, believed: Tensor, known: Sequence[Finding] = ()
    ) -> list[Finding]:
        """Of what came since `start`, likeliest first. known: what was found of it before."""
        s, healthy, window = self.settings, self._healthy(believed), state.window(start)
        return isolate(self.observer, window, believed, self.faults, s.incipient, s.together, healthy, known)


def faults_of(names: Sequence[str]) -> list[Fault]:
    """The faults that parameters make up: an oscillation's period and phase belong to its amplitude."""
    faults = []
    for column, name in enumerate(names):
        effect, _, field = name.rpartition(".")
        if field not in SHAPE:
            shape = tuple(names.index(f"{effect}.{s}") for s in SHAPE if f"{effect}.{s}" in names)
            faults.append(Fault(column, shape))
    return faults
