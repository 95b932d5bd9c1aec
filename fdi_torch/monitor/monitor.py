"""The monitor: observer, alarms, isolation and fault sizes along a recording.

It extends the adaptive observer of the 2020 paper (eq. 16), which feeds newly estimated parameters back into the
observer. Here the parameters and the time of the change are estimated from the whitened innovations. An event depends
only on the samples up to its time, not on how many samples are passed in one call.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.monitor.alarm_handling import AlarmHandler
from fdi_torch.monitor.detection import Detector
from fdi_torch.monitor.event_text import EventWriter
from fdi_torch.monitor.events import Event
from fdi_torch.monitor.explanations import Explainer
from fdi_torch.monitor.hypothesis import faults_of
from fdi_torch.monitor.monitor_settings import MonitorSettings, usual_settings
from fdi_torch.monitor.monitor_state import MonitorState
from fdi_torch.monitor.noise_model import NoiseModel
from fdi_torch.monitor.observer_bank import LONG_AGO, ObserverBank
from fdi_torch.monitor.samples import Samples, split_at_gaps
from fdi_torch.monitor.state_update import ResidualTest, advance_observer, drop_old_samples, initial_state
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork

LARGEST_BATCH = 512  # samples that the observer processes before the detector checks them


@dataclass(frozen=True)
class ResidualTrace:
    """Residuals and detector output, sample by sample.

    time (S,) s; residual (S, sensors) in the readings' units; statistic (S,), which the detector compares with its
    threshold.
    """

    time: Tensor
    residual: Tensor
    statistic: Tensor


class Monitor:
    """Monitor of one plant. It holds no state of its own: `advance` takes a state and returns the next one.

    The first `watched` parameters of `space` (all by default) are faults that may occur, and the last `unlisted` ones
    faults that are not on the list: none of them is reported by its name, nor used by the observer. The others are
    calibrated constants, which stay fixed.
    """

    def __init__(
        self,
        network: TankNetwork,
        space: ParameterSpace,
        noise: NoiseModel,
        detector: Detector,
        settings: MonitorSettings | None = None,
        longest_step: float | None = None,
        watched: int | None = None,
        unlisted: int = 0,
    ) -> None:
        if not len(space):
            raise ValueError("expected at least one fault to watch for, got none; name some")
        self.network, self.space, self.noise, self.detector = network, space, noise, detector
        self.settings = settings or usual_settings(network.description)
        self.watched = len(space) - unlisted if watched is None else watched
        self.faults = faults_of(space.names[: self.watched])
        self.observer = ObserverBank(network, space, noise.gain, noise.whitening, longest_step, noise.constants)
        self.writer = EventWriter(self.observer, self.settings, self.watched)
        outside = [f for f in faults_of(space.names) if f.size >= len(space) - unlisted]
        explainer = Explainer(self.observer, self.faults, self.settings, outside)
        self.test = ResidualTest(detector, self.settings.lookback)
        self.alarms = AlarmHandler(explainer, self.test, self.writer)
        self.fewest = self.test.reach + noise.whitening.order + 1

    def start(
        self,
        samples: Samples,
        believed: Tensor | None = None,
        levels: Tensor | None = None,
        learning_until: float = LONG_AGO,
    ) -> MonitorState:
        """The state after the first sample.

        believed (P,): parameter values that the observer uses, nominal by default. levels (tanks,) m: from the readings
        by default. learning_until: end of the segment from which the noise was learnt, s; before it the monitor raises
        no alarm, because it would use noise estimates from readings that are still to come.
        """
        nominal = self.space.nominal()
        theta = nominal if believed is None else believed
        healthy = torch.cat([nominal[: self.watched], theta[self.watched :]])  # calibrated constants as they are
        state = initial_state(
            self.observer,
            samples,
            theta,
            healthy,
            levels=levels,
            correlation_time=self.settings.lookback,
        )
        return replace(state, learning_until=learning_until)

    def advance(
        self, state: MonitorState, samples: Samples, show: Callable[[ResidualTrace], None] | None = None
    ) -> tuple[MonitorState, list[Event]]:
        """Process further samples in order. Gaps, jumps of the clock and missing values are allowed.

        show: called with residuals and detector statistic, in order.
        """
        events: list[Event] = []
        segments, clock = split_at_gaps(state.clock, samples, self.noise.interval)
        for segment, notice in segments:
            if notice:
                state, new_events = self._restart(state, segment, notice)
                events += new_events
                segment = segment.segment(1, len(segment))
            while len(segment):
                state, taken, new_events = self._process(state, segment, show)
                events += new_events
                segment = segment.segment(taken, len(segment))
        return replace(state, clock=clock), events

    def close(self, state: MonitorState) -> list[Event]:
        """A summary event for each alarm, at the end of the recording."""
        return [self.writer.summary(state, alarm) for alarm in state.alarms]

    def _restart(self, state: MonitorState, samples: Samples, notice: str) -> tuple[MonitorState, list[Event]]:
        """Restart the observer after a gap. Isolated faults stay in its parameters; a pending alarm is retired.

        If the clock went back, the times of the faults go back with it: they would otherwise lie in the future.
        """
        fresh = initial_state(
            self.observer,
            samples.segment(0, 1),
            state.believed,
            state.healthy,
            correlation_time=self.settings.lookback,
        )
        back = min(fresh.now - state.now, 0.0)
        fresh = replace(
            fresh,
            alarms=state.alarms,
            tracks=tuple(track.moved(back) for track in state.tracks),
            hidden=tuple(fault.moved(back) for fault in state.hidden),
            pending=state.pending,
            learning_until=state.learning_until,
            outages=state.outages,
            errors=replace(fresh.errors, constants=state.errors.constants).as_calibrated(),
        )
        events = [self.writer.notice(fresh, notice)]
        if state.pending is not None:
            fresh, event = self.alarms.retire(
                fresh, state.pending.number, "the samples that would explain it are missing"
            )
            events.append(event)
        fresh, notices = self._with_outages(fresh, samples.segment(0, 1))
        return fresh, [*events, *notices]

    def _with_outages(self, state: MonitorState, samples: Samples) -> tuple[MonitorState, list[Event]]:
        """The state with the outages of sensors after its last samples, and the notices about them."""
        outages, notices = state.outages.along(samples, state.learning_until)
        return replace(state, outages=outages), [self.writer.notice(state, text) for _, text in notices]

    def _process(
        self, state: MonitorState, samples: Samples, show: Callable[[ResidualTrace], None] | None
    ) -> tuple[MonitorState, int, list[Event]]:
        """Process samples up to the next alarm, notice or scheduled fit, and carry that out. Returns their number."""
        learning = state.learning_until > LONG_AGO
        due = samples.time >= (state.learning_until if learning else self.alarms.next_fit(state))
        count = int(due.to(torch.int8).argmax()) + 1 if bool(due.any()) else len(samples)
        count = min(count, LARGEST_BATCH)
        outages = state.outages.along(samples.segment(0, count), state.learning_until)[1]
        count = min([count, *(first + 1 for first, _ in outages)])
        moved, statistic = self._observed(state, samples.segment(0, count))
        above = statistic > self.detector.threshold
        listens = state.pending is None or state.pending.attempts > 0
        raised = listens and not learning and bool(above.any())
        if raised:
            count = int(above.to(torch.int8).argmax()) + 1
            moved, statistic = self._observed(state, samples.segment(0, count))
        if show is not None:
            show(ResidualTrace(moved.samples.time[-count:], moved.residual[-count:], statistic))
        moved, notices = self._with_outages(moved, samples.segment(0, count))
        earliest = max(moved.earliest_start, self.alarms.earliest_start(moved))
        moved = drop_old_samples(replace(moved, earliest_start=earliest), self.fewest)
        if learning:
            if moved.now >= state.learning_until:  # no window reaches into the part that is declared fault-free
                moved = replace(
                    moved,
                    learning_until=LONG_AGO,
                    detector_memory=None,
                    earliest_start=state.learning_until,
                    errors=moved.errors.as_learnt(),
                )
            return moved, count, notices
        state, events = self.alarms.on_threshold(moved) if raised else (moved, [])
        if not raised and state.now >= self.alarms.next_fit(state):
            state, events = self.alarms.on_schedule(state)
        return state, count, [*notices, *events]

    def _observed(self, state: MonitorState, samples: Samples) -> tuple[MonitorState, Tensor]:
        """The state after the samples, and the detector's statistic (S,) at each of them."""
        moved = advance_observer(self.observer, state, samples)
        statistic, memory = self.test.statistic(moved, len(samples), state.detector_memory)
        return replace(moved, detector_memory=memory), statistic
