"""What the monitor does after an alarm: isolate the fault, adopt it, revise it later, and end or retire the alarm.

An alarm is pending for `settings.confirm` seconds. Then all single changes, and the best pairs, are fitted. The
likeliest explanation goes into the observer, and is fitted again each time the time since the onset has grown by
`settings.revise`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from torch import Tensor

from fdi_torch.monitor.alarm_state import Alarm, State
from fdi_torch.monitor.detection import Detector
from fdi_torch.monitor.event_text import EventWriter
from fdi_torch.monitor.events import Event, Kind
from fdi_torch.monitor.fault_recovery import (
    end_is_shown,
    recovered_columns,
    recovery_is_observable,
    reset_to_nominal,
)
from fdi_torch.monitor.fault_tracking import (
    STRONG_EVIDENCE,
    effect_of_value,
    size_change,
    updated_tracks,
    with_new_sizes,
)
from fdi_torch.monitor.hypothesis import Fault, HypothesisFit, credible_set, merged
from fdi_torch.monitor.isolation import isolate
from fdi_torch.monitor.monitor_settings import MonitorSettings
from fdi_torch.monitor.monitor_state import DetectedChange, HiddenFault, MonitorState, PendingAlarm
from fdi_torch.monitor.observer_bank import ObserverBank
from fdi_torch.monitor.state_update import adopt_change, adopt_sizes, normalized_residuals

GROWING_WINDOWS = 8.0  # longest windows over which one straight line describes a fault that grows
SMALLEST_PROBABILITY = 1e-3  # explanations below it are not fitted again


class AlarmHandler:
    """Alarm logic of one monitor; each method takes a state and returns the next one with the events it causes."""

    def __init__(
        self,
        observer: ObserverBank,
        detector: Detector,
        faults: Sequence[Fault],
        watched: int,
        settings: MonitorSettings,
        writer: EventWriter,
    ) -> None:
        self.observer, self.space, self.detector = observer, observer.space, detector
        self.faults, self.watched, self.settings, self.writer = faults, watched, settings, writer
        self.reach = max(round(settings.lookback / detector.design.interval), 1)

    # Schedule

    def next_fit(self, state: MonitorState) -> float:
        """When something is examined next, s: the pending alarm, else the latest change or a hidden fault."""
        if state.pending is not None:
            raised = state.alarm(state.pending.number).last
            return raised + self.settings.confirm * self.settings.revise**state.pending.attempts
        changes = [] if state.change is None else [state.change.next_fit]
        return min([*changes, *map(self._next_look, state.hidden)], default=float("inf"))

    def earliest_start(self, state: MonitorState) -> float:
        """The earliest time at which a later window may begin, s."""
        raised = state.now if state.pending is None else state.alarm(state.pending.number).last
        usual, change = raised - self.settings.longest - self.settings.lookback, state.change
        if change is None or not change.best.hypothesis.incipient or not self._within_window(state, change):
            return usual
        return min(usual, change.best.onset - self.settings.lookback)

    # Entry points

    def on_threshold(self, state: MonitorState) -> tuple[MonitorState, list[Event]]:
        """Handle a crossing of the detector's threshold.

        It is a new alarm unless the latest change still explains the residual, or a known fault only changed its size.
        """
        change = state.change
        if change is not None and self._within_window(state, change):
            fits = self._explanations(state, self._window_start(state, change), change.before, change.explanations)
            if fits[0].fits and fits[0].hypothesis.columns:
                state = state.with_alarm(state.alarm(change.number).raised_again(state.now))
                return self._revise(state, change, "revised", fits, announce=False)
        resized = size_change(self.observer, state, self._search_start(state, state.now), self.faults)
        if resized is not None:
            moved = adopt_sizes(self.observer, state, resized)
            moved, announced = with_new_sizes(moved, resized, self.settings.revise)
            changed = [t for t in moved.tracks if t.column in resized.hypothesis.columns]
            return moved, self.writer.followed(moved, changed, announced)
        alarm = Alarm(len(state.alarms) + 1, state.now, state.now, self._sensor_shares(state))
        raised = replace(state, alarms=(*state.alarms, alarm), pending=PendingAlarm(alarm.number))
        return raised, [self.writer.raised(raised, alarm)]

    def on_schedule(self, state: MonitorState) -> tuple[MonitorState, list[Event]]:
        """Isolate the pending alarm, fit all explanations of the latest change again, or examine hidden faults."""
        change = state.change
        if state.pending is None:
            if change is not None and state.now >= change.next_fit:
                return self._reconsider(state, change)
            return self._examine_hidden(state)
        if change is not None and self._within_window(state, change):
            # The previous change may have been explained wrongly: one change that explains both alarms is preferred.
            start, earlier = self._window_start(state, change), change.explanations
            fits = self._explanations(state, start, change.before, earlier)
            if fits[0].fits and fits[0].hypothesis.columns:
                return self._same_change(state, change, fits)
            if change.best.at_bound:
                return self._same_change(state, change, fits)
        return self._isolate(state)

    def retire(
        self, state: MonitorState, number: int, reason: str, announced: bool = True
    ) -> tuple[MonitorState, Event]:
        """End an alarm that has no explanation of its own."""
        retired = state.alarm(number).with_state(State.RETIRED)
        state = replace(state, pending=None, detector_memory=None).with_alarm(retired)
        return state, self.writer.retired(state, retired, reason, announced)

    def fault_free(self, believed: Tensor) -> Tensor:
        """Parameter values (P,) with every fault at nominal and the calibrated constants as they are."""
        healthy = believed.clone()
        healthy[: self.watched] = self.space.nominal()[: self.watched]
        return healthy

    # Isolation

    def _isolate(self, state: MonitorState) -> tuple[MonitorState, list[Event]]:
        assert state.pending is not None
        number = state.pending.number
        fits = self._explanations_from_onset(state, self._search_start(state, state.alarm(number).last))
        if not fits[0].hypothesis.columns:
            return self._unexplained(state, fits)
        alarm = state.alarm(number)
        events: list[Event] = []
        earlier_alarm = self._alarm_of_known_faults(state, fits[0])
        if earlier_alarm is not None:  # only the size of a known fault changed
            state, event = self.retire(state, number, f"it counts with alarm {earlier_alarm}", announced=False)
            events, number = [event], earlier_alarm
            state = state.with_alarm(state.alarm(earlier_alarm).raised_again(alarm.last))
        since = self._parameters_valid_since(state)
        next_fit = self._next_revision(fits[0], state.now)
        change = DetectedChange(number, state.believed, since, tuple(fits), alarm.last, next_fit)
        state, answer = self._adopt(state, change, "isolated")
        return state, [*events, *answer]

    def _same_change(
        self, state: MonitorState, change: DetectedChange, fits: Sequence[HypothesisFit]
    ) -> tuple[MonitorState, list[Event]]:
        """Count the pending alarm with the alarm of the latest change, which explains both."""
        assert state.pending is not None
        alarm = state.alarm(state.pending.number)
        state, event = self.retire(state, alarm.number, f"it counts with alarm {change.number}", announced=False)
        state = state.with_alarm(state.alarm(change.number).raised_again(alarm.last))
        if not fits[0].hypothesis.columns:
            return replace(state, pending=None), [event]
        revised, events = self._revise(state, change, "isolated", fits)
        return revised, [event, *events]

    def _reconsider(self, state: MonitorState, change: DetectedChange) -> tuple[MonitorState, list[Event]]:
        """Fit all explanations of the latest change again.

        If none of them fits the noise level, the change is replaced only by a clearly likelier one.
        """
        if not self._within_window(state, change):
            return replace(state, change=replace(change, next_fit=float("inf"))), []
        fits = self._explanations(state, self._window_start(state, change), change.before, change.explanations)
        best = fits[0]
        present = [f for f in fits if f.hypothesis.columns == change.best.hypothesis.columns]
        resized = state.adjusted > change.best.onset  # sizes changed since, so no single change explains the window
        not_better = (
            resized
            or not best.hypothesis.columns
            or (present and best.evidence - present[0].evidence < STRONG_EVIDENCE)
        )
        if not best.fits and not_better:
            later = self._next_revision(change.best, state.now)
            return replace(state, change=replace(change, next_fit=later)), []
        return self._revise(state, change, "revised", fits)

    def _unexplained(self, state: MonitorState, fits: Sequence[HypothesisFit]) -> tuple[MonitorState, list[Event]]:
        """Report once that no fault explains the alarm, and try again until the longest window is full."""
        assert state.pending is not None
        number, attempts = state.pending.number, state.pending.attempts + 1
        waiting, events = replace(state, pending=PendingAlarm(number, attempts)), []
        if attempts == 1:
            waiting = waiting.with_alarm(waiting.alarm(number).with_state(State.CANNOT_TELL))
            events = [self.writer.unexplained(waiting, number, self._reported(fits))]
        if self.next_fit(waiting) - state.alarm(number).last <= self.settings.longest:
            return waiting, events
        waiting, event = self.retire(waiting, number, "no fault of the list explains it better than chance does")
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
        next_fit = self._next_revision(fits[0], state.now)
        revised = replace(change, explanations=tuple(fits), alarm_time=alarm_time, next_fit=next_fit)
        return self._adopt(state, revised, kind, announce)

    def _adopt(
        self, state: MonitorState, change: DetectedChange, kind: Kind, announce: bool = True
    ) -> tuple[MonitorState, list[Event]]:
        """Put the likeliest explanation into the observer, and update the alarm's state and the fault tracks.

        announce: whether the event is announced even if only the sizes changed.
        """
        reported = self._reported(change.explanations)
        best = reported[0]
        kept = tuple(
            f
            for f in merged(change.explanations)
            if f.hypothesis.columns and (f.probability > SMALLEST_PROBABILITY or f in reported)
        )
        change = replace(change, explanations=kept)
        back = recovered_columns(self.space, change)
        ended = tuple(t for t in (change.ended or state.tracks) if t.column in back)
        names = tuple(tuple(self.space.names[c] for c in f.hypothesis.columns) for f in reported)
        announce = announce or names != change.reported
        change = replace(change, ended=ended, reported=names)
        state = adopt_change(self.observer, state, change, reset_to_nominal(self.space, change, back))
        window, healthy = state.window(change.best.onset), state.healthy.tolist()
        state = updated_tracks(
            state,
            change,
            [fault.size for fault in self.faults],
            lambda c: effect_of_value(self.observer, window, change.before, change.hypothesis, c, healthy[c])[0],
        )
        state = self._with_hidden(state, change)
        state, events = self._end_recovered(state, change, reported)
        present = [c for c in best.hypothesis.sizes if c not in back]
        if not present:
            numbers = [t.number for t in ended]
            if change.number not in numbers and state.alarm(change.number).state is not State.RETIRED:
                reason = f"it is the end of alarm {numbers[0]}" if numbers else "what changed is nominal"
                state, event = self.retire(state, change.number, reason, announced=False)
                events.append(event)
            return state, events
        alarm = state.alarm(change.number)
        answer = self._answer_of(reported)
        state = state.with_alarm(replace(alarm.with_state(answer), faults=tuple(self.space.names[c] for c in present)))
        kind = kind if kind == "revised" and alarm.state is answer else str(answer)  # type: ignore[assignment]
        return state, [*events, self.writer.answered(state, change, reported, kind, announce or kind != "revised")]

    def _with_hidden(self, state: MonitorState, change: DetectedChange) -> MonitorState:
        """The state with the faults that recovered at a change but that the readings since would not show."""
        onset, now = change.best.onset, state.now
        hidden = [t for t in change.ended if not recovery_is_observable(self.observer, state, change, t)]
        new = [HiddenFault(t, float(change.before[t.column]), onset, now) for t in hidden]
        judged = {*change.best.hypothesis.columns, *state.off_nominal.nonzero().flatten().tolist()}
        return replace(state, hidden=(*(h for h in state.hidden if h.track.column not in judged), *new))

    def _examine_hidden(self, state: MonitorState) -> tuple[MonitorState, list[Event]]:
        """Report the hidden faults of which the readings since the last look show that they have ended."""
        valid, due = self._parameters_valid_since(state), [h for h in state.hidden if self._next_look(h) <= state.now]
        gone = [h for h in due if end_is_shown(self.observer, state, h, max(h.seen, valid))]
        hidden = (replace(h, seen=state.now) if h in due else h for h in state.hidden if h not in gone)
        state, events = replace(state, hidden=tuple(hidden)), []
        if state.change is not None:
            ended = tuple(t for t in state.change.ended if t not in [h.track for h in gone])
            state = replace(state, change=replace(state.change, ended=ended))
        standing = {t.number for t in (*state.tracks, *(h.track for h in state.hidden))}
        for number in sorted({h.track.number for h in gone}):
            if number not in standing and state.alarm(number).state is State.CANNOT_TELL:
                state = state.with_alarm(state.alarm(number).with_state(State.RECOVERED))
            events.append(self.writer.end_shown(state, number, [h for h in gone if h.track.number == number]))
        return state, events

    def _end_recovered(
        self, state: MonitorState, change: DetectedChange, reported: Sequence[HypothesisFit]
    ) -> tuple[MonitorState, list[Event]]:
        """End the alarms of recovered faults; "cannot tell" if the readings would not show one of them any more."""
        events, unseen = [], [h.track.column for h in state.hidden]
        for number in sorted({t.number for t in change.ended}):
            columns, alarm = [t.column for t in change.ended if t.number == number], state.alarm(number)
            hidden = [c for c in columns if c in unseen]
            answer = State.CANNOT_TELL if hidden else State.RECOVERED
            if alarm.state is not answer:
                state = state.with_alarm(alarm.with_state(answer))
                names = [self.space.names[c] for c in hidden or columns]
                events.append(self.writer.ended(state, change, reported, number, names, not hidden))
        return state, events

    @staticmethod
    def _answer_of(reported: Sequence[HypothesisFit]) -> State:
        best = reported[0]
        if best.at_bound:
            return State.CANNOT_TELL
        return State.ISOLATED if len(reported) == 1 and best.fits else State.EXPLAINED

    def _reported(self, fits: Sequence[HypothesisFit]) -> list[HypothesisFit]:
        return credible_set(merged(fits), self.settings.level)

    # Windows and fits

    def _explanations(
        self, state: MonitorState, start: float, believed: Tensor, earlier: Sequence[HypothesisFit] = ()
    ) -> list[HypothesisFit]:
        """Explanations of the readings since `start` s, likeliest first. earlier: fits that serve
        as initial guesses.
        """
        s, healthy, window = self.settings, self.fault_free(believed), state.window(start)
        return isolate(self.observer, window, believed, self.faults, s.incipient, s.together, healthy, earlier)

    def _explanations_from_onset(self, state: MonitorState, start: float) -> list[HypothesisFit]:
        """Explanations of the readings since `start` s.

        The window is doubled while the onset lies at its beginning, because the change may have occurred before it.
        """
        earliest = max(self._parameters_valid_since(state), state.earliest_start)
        while True:
            fits = self._explanations(state, start, state.believed)
            at_start = fits[0].onset - start <= 2.0 * fits[0].onset_std and bool(fits[0].hypothesis.columns)
            if not at_start or start <= earliest:
                return fits
            start = max(start - (state.now - start), earliest)

    def _sensor_shares(self, state: MonitorState) -> tuple[tuple[str, float], ...]:
        """The share of each sensor in the detector's statistic."""
        since = max(self._search_start(state, state.now), state.now - self.settings.lookback)
        white = normalized_residuals(state, max(int((state.samples.time > since).sum()), 1), self.reach)
        names = [sensor.name for sensor in self.observer.network.description.sensors]
        return tuple(zip(names, self.detector.shares(white).tolist(), strict=True))

    def _search_start(self, state: MonitorState, alarm_time: float) -> float:
        """The earliest onset of a change that raised an alarm, s: not before the previous change."""
        return max(alarm_time - self.settings.lookback, self._parameters_valid_since(state))

    def _parameters_valid_since(self, state: MonitorState) -> float:
        """Since when the observer's present parameters have applied, s."""
        last = state.change.best.onset if state.change is not None else state.reachable
        return max(state.reachable, last, state.adjusted)

    def _window_start(self, state: MonitorState, change: DetectedChange) -> float:
        """Start of the window in which the latest change is fitted again, s."""
        return max(change.best.onset - self.settings.lookback, change.since, state.reachable)

    def _within_window(self, state: MonitorState, change: DetectedChange) -> bool:
        longest = self.settings.longest * (GROWING_WINDOWS if change.best.hypothesis.incipient else 1.0)
        return state.now - change.best.onset <= longest and change.best.onset >= state.reachable

    def _next_revision(self, fit: HypothesisFit, now: float) -> float:
        return fit.onset + self.settings.revise * max(now - fit.onset, self.settings.confirm)

    def _next_look(self, fault: HiddenFault) -> float:
        return fault.seen + self.settings.confirm
