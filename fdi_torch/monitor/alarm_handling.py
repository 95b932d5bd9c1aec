"""What the monitor does after an alarm: isolate the fault, adopt it, revise it later, and end or retire the alarm.

An alarm is pending for `settings.confirm` seconds. Then all single changes, and the best pairs, are fitted. The
likeliest explanation goes into the observer, and is fitted again each time the time since the onset has grown by the
factor REVISE.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from fdi_torch.monitor.alarm_state import Alarm, State
from fdi_torch.monitor.event_text import EventWriter
from fdi_torch.monitor.events import Event, Kind
from fdi_torch.monitor.explanations import Explainer, answer_of
from fdi_torch.monitor.hypothesis import HypothesisFit, merged
from fdi_torch.monitor.isolation import SMALLEST_PROBABILITY
from fdi_torch.monitor.known_faults import (
    STRONG_EVIDENCE,
    end_recovered,
    examine_hidden,
    possible_ends,
    recovered_columns,
    reset_to_nominal,
    size_change,
    updated_tracks,
    with_hidden,
    with_new_sizes,
)
from fdi_torch.monitor.monitor_settings import REVISE
from fdi_torch.monitor.monitor_state import DetectedChange, HiddenFault, MonitorState, PendingAlarm
from fdi_torch.monitor.state_update import ResidualTest, adopt, adopt_change, beside_deviation


class AlarmHandler:
    """Alarm logic of one monitor; each method takes a state and returns the next one with the events it causes."""

    def __init__(self, explainer: Explainer, test: ResidualTest, writer: EventWriter) -> None:
        self.explainer, self.observer, self.faults = explainer, explainer.observer, explainer.faults
        self.space, self.settings = self.observer.space, explainer.settings
        self.test, self.writer = test, writer

    # Schedule

    def next_fit(self, state: MonitorState) -> float:
        """When something is examined next, s: the pending alarm, else the latest change or a hidden fault."""
        if state.pending is not None:
            raised = state.alarm(state.pending.number).last
            return raised + self.settings.confirm * REVISE**state.pending.attempts
        changes = [] if state.change is None else [state.change.next_fit]
        return min([*changes, *(self._next_look(h) for h in state.hidden)], default=float("inf"))

    def earliest_start(self, state: MonitorState) -> float:
        """The earliest time at which a later window may begin, s."""
        raised = state.now if state.pending is None else state.alarm(state.pending.number).last
        usual, change = raised - self.settings.longest - self.settings.lookback, state.change
        if change is None or not change.best.hypothesis.incipient or not self.explainer.is_current(state, change):
            return usual
        return min(usual, change.best.onset - self.settings.lookback)

    def _next_look(self, fault: HiddenFault) -> float:
        return fault.seen + self.settings.confirm

    # Entry points

    def on_threshold(self, state: MonitorState) -> tuple[MonitorState, list[Event]]:
        """Handle a crossing of the detector's threshold.

        It is a new alarm unless the latest change still explains the residual, or a known fault only changed its size.
        It ends one that chance explains.
        """
        if state.pending is not None:
            number = state.pending.number
            state, retired = self.retire(state, number, "the residual left its range again", announced=False)
            state, events = self.on_threshold(state)
            return state, [retired, *events]
        change = state.change
        if change is not None and self.explainer.is_current(state, change):
            fits = self.explainer.of_change(state, change)
            if fits[0].fits and fits[0].hypothesis.columns:
                again = state.with_alarm(state.alarm(change.number).raised_again(state.now))
                revised, events = self._revise(again, change, "revised", fits, announce=False)
                if self.test.is_quiet(revised):
                    return revised, events
        resized = size_change(self.observer, state, self.explainer.search_start(state, state.now), self.faults)
        if resized is not None:
            moved = adopt(self.observer, state, resized.value, state.believed, resized)
            moved, announced = with_new_sizes(moved, resized)
            changed = [t for t in moved.tracks if t.column in resized.hypothesis.columns]
            return moved, self.writer.followed(moved, changed, announced)
        sensors = [sensor.name for sensor in self.observer.network.description.sensors]
        shares = self.test.shares(state, self.explainer.search_start(state, state.now))
        alarm = Alarm(len(state.alarms) + 1, state.now, state.now, tuple(zip(sensors, shares, strict=True)))
        raised = replace(state, alarms=(*state.alarms, alarm), pending=PendingAlarm(alarm.number))
        return raised, [self.writer.raised(raised, alarm)]

    def on_schedule(self, state: MonitorState) -> tuple[MonitorState, list[Event]]:
        """Isolate the pending alarm, fit all explanations of the latest change again, or examine hidden faults."""
        change = state.change
        if state.pending is None:
            if change is not None and state.now >= change.next_fit:
                return self._reconsider(state, change)
            due = [h for h in state.hidden if self._next_look(h) <= state.now]
            return examine_hidden(self.observer, self.writer, state, due)
        if change is not None and self.explainer.is_current(state, change):
            # The previous change may have been explained wrongly: one change that explains both alarms is preferred.
            fits = self.explainer.of_change(state, change)
            if fits[0].fits and fits[0].hypothesis.unlisted:
                counted, event = self._counted_with(state, change)
                counted, events = self._not_on_list(counted, change, fits)
                return counted, [event, *events]
            if fits[0].fits and fits[0].hypothesis.columns:
                counted, event = self._counted_with(state, change)
                counted, events = self._revise(counted, change, "isolated", fits)
                if self.test.is_quiet(counted):
                    return counted, [event, *events]
        return self._isolate(state)

    def retire(
        self, state: MonitorState, number: int, reason: str, announced: bool = True
    ) -> tuple[MonitorState, Event]:
        """End an alarm that has no explanation of its own."""
        retired = state.alarm(number).with_state(State.RETIRED)
        state = replace(state, pending=None, detector_memory=None).with_alarm(retired)
        return state, self.writer.retired(state, retired, reason, announced)

    # Isolation

    def _isolate(self, state: MonitorState) -> tuple[MonitorState, list[Event]]:
        assert state.pending is not None
        number = state.pending.number
        fits = self.explainer.of_alarm(state, state.alarm(number).last)
        if not fits[0].hypothesis.columns:
            return self._unexplained(state, fits)
        alarm = state.alarm(number)
        events: list[Event] = []
        earlier_alarm = self._alarm_of_known_faults(state, fits[0])
        if earlier_alarm is not None:  # only the size of a known fault changed
            state, event = self.retire(state, number, f"it belongs to alarm {earlier_alarm}", announced=False)
            events, number = [event], earlier_alarm
            state = state.with_alarm(state.alarm(earlier_alarm).raised_again(alarm.last))
        next_fit = self.explainer.next_fit(fits[0], state.now)
        change = DetectedChange(number, state.believed, state.valid_since, tuple(fits), alarm.last, next_fit)
        state, answer = self._adopt(state, change, "isolated")
        return state, [*events, *answer]

    def _counted_with(self, state: MonitorState, change: DetectedChange) -> tuple[MonitorState, Event]:
        """Count the pending alarm with the alarm of the latest change, which explains both."""
        assert state.pending is not None
        alarm = state.alarm(state.pending.number)
        state, event = self.retire(state, alarm.number, f"it belongs to alarm {change.number}", announced=False)
        return state.with_alarm(state.alarm(change.number).raised_again(alarm.last)), event

    def _reconsider(self, state: MonitorState, change: DetectedChange) -> tuple[MonitorState, list[Event]]:
        """Fit all explanations of the latest change again.

        If none of them fits the noise level, the change is replaced only by a clearly likelier one.
        """
        if not self.explainer.is_current(state, change):
            return replace(state, change=replace(change, next_fit=float("inf"))), []
        fits = self.explainer.of_change(state, change)
        best = fits[0]
        if best.fits and not best.hypothesis.columns:
            return self._not_on_list(state, change, fits)
        present = [f for f in fits if f.hypothesis.columns == change.best.hypothesis.columns]
        resized = state.adjusted > change.best.onset  # sizes changed since, so no single change explains the window
        not_better = (
            resized
            or not best.hypothesis.columns
            or (present and best.evidence - present[0].evidence < STRONG_EVIDENCE)
        )
        if not best.fits and not_better:
            later = self.explainer.next_fit(change.best, state.now)
            return replace(state, change=replace(change, next_fit=later)), []
        return self._revise(state, change, "revised", fits)

    def _not_on_list(
        self, state: MonitorState, change: DetectedChange, fits: Sequence[HypothesisFit]
    ) -> tuple[MonitorState, list[Event]]:
        """Report that a cause that is not on the list, or chance, explains the latest change better.

        The observer keeps its parameters as a substitute for such a cause, but they are no known fault any more. By
        chance nothing changed, so that it goes on with those before the change.
        """
        reported = self.explainer.reported(fits)
        names, next_fit = self._names(reported), self.explainer.next_fit(change.best, state.now)
        tracks = tuple(t for t in state.tracks if t.number != change.number)
        told, change = change.reported, replace(change, next_fit=next_fit, reported=names)
        moved = replace(state, change=change, tracks=tracks)
        if not fits[0].hypothesis.unlisted:
            moved = adopt_change(self.observer, moved, change, change.before)
        moved, event = self._cannot_tell(moved, change.number, reported)
        return moved, [] if names == told else [event]

    def _cannot_tell(
        self, state: MonitorState, number: int, reported: Sequence[HypothesisFit]
    ) -> tuple[MonitorState, Event]:
        """Report explanations of which the likeliest is no fault of the list, and restart the detector beside it."""
        told = beside_deviation(state).with_alarm(state.alarm(number).with_state(State.CANNOT_TELL))
        event = self.writer.unexplained(told, number, reported)
        return told.with_alarm(replace(told.alarm(number), explanations=event.explanations)), event

    def _names(self, reported: Sequence[HypothesisFit]) -> tuple[tuple[str, ...], ...]:
        """Parameter names of each explanation."""
        return tuple(tuple(self.space.names[c] for c in f.hypothesis.columns) for f in reported)

    def _unexplained(self, state: MonitorState, fits: Sequence[HypothesisFit]) -> tuple[MonitorState, list[Event]]:
        """Report once that no fault explains the alarm, and try again until the longest window is full."""
        assert state.pending is not None
        number, attempts = state.pending.number, state.pending.attempts + 1
        waiting, events = replace(state, pending=PendingAlarm(number, attempts)), []
        if attempts == 1:
            waiting, event = self._cannot_tell(waiting, number, self.explainer.reported(fits))
            events = [event]
        if self.next_fit(waiting) - state.alarm(number).last <= self.settings.longest:
            return waiting, events
        waiting, event = self.retire(waiting, number, "no fault of the list explains it")
        return waiting, [*events, event]

    def _alarm_of_known_faults(self, state: MonitorState, best: HypothesisFit) -> int | None:
        """The alarm to which all faults of an explanation belong; None if one is new or recovers."""
        if best.hypothesis.recovered:
            return None
        owners = {c: t.number for t in state.tracks for c in best.hypothesis.sizes if t.column == c}
        numbers = set(owners.values())
        return numbers.pop() if len(owners) == len(best.hypothesis.sizes) and len(numbers) == 1 else None

    # Adoption of an explanation

    def _revise(
        self,
        state: MonitorState,
        change: DetectedChange,
        kind: Kind,
        fits: Sequence[HypothesisFit],
        announce: bool = True,
    ) -> tuple[MonitorState, list[Event]]:
        """Adopt the latest change with new explanations."""
        alarm_time = change.alarm_time if change.alarm_time > fits[0].onset else state.alarm(change.number).last
        next_fit = self.explainer.next_fit(fits[0], state.now)
        revised = replace(change, explanations=tuple(fits), alarm_time=alarm_time, next_fit=next_fit)
        return self._adopt(state, revised, kind, announce)

    def _adopt(
        self, state: MonitorState, change: DetectedChange, kind: Kind, announce: bool = True
    ) -> tuple[MonitorState, list[Event]]:
        """Put the likeliest explanation into the observer, and update the alarm's state and the fault tracks.

        announce: whether the event is announced even if only the sizes changed.
        """
        reported = self.explainer.reported(change.explanations)
        best = reported[0]
        kept = tuple(
            f
            for f in merged(change.explanations)
            if f.hypothesis.columns and (f.probability > SMALLEST_PROBABILITY or f in reported)
        )
        change = replace(change, explanations=kept)
        back = recovered_columns(self.space, change)
        told, ended = change.ended, tuple(t for t in (change.ended or state.tracks) if t.column in back)
        names = self._names(reported)
        announce = announce or names != change.reported
        change = replace(change, ended=ended, reported=names)
        state = adopt_change(self.observer, state, change, reset_to_nominal(self.space, change, back))
        if not best.fits:
            state = beside_deviation(state)
        state = updated_tracks(self.observer, state, change, self.faults)
        ends = possible_ends(self.observer, state, change, self.settings.lookback)
        state = with_hidden(self.observer, state, change, ends, self.settings.confirm)
        state, events = end_recovered(self.writer, state, change, reported, ends, told)
        present = [c for c in best.hypothesis.sizes if c not in back]
        if not present:
            numbers = [t.number for t in ended]
            if change.number not in numbers and state.alarm(change.number).state is not State.RETIRED:
                reason = f"it is the end of alarm {numbers[0]}" if numbers else "what changed is nominal"
                state, event = self.retire(state, change.number, reason, announced=False)
                events.append(event)
            return state, events
        alarm = state.alarm(change.number)
        answer = answer_of(reported)
        state = state.with_alarm(alarm.with_state(answer))
        kind = kind if kind == "revised" and alarm.state is answer else str(answer)  # type: ignore[assignment]
        event = self.writer.answered(state, change, reported, kind, announce or kind != "revised")
        likeliest, *rivals = event.explanations
        named = likeliest.restricted_to([self.space.names[c] for c in present])
        state = state.with_alarm(replace(state.alarm(change.number), explanations=(named, *rivals)))
        return state, [*events, event]
