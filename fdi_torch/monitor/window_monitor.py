"""The adaptive observer of the 2020 paper (eq. 16): fit all faults in successive windows and feed them back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.estimate.fitting import Fitting, set_up
from fdi_torch.monitor.events import Event, Explanation, Kind, size_of
from fdi_torch.monitor.monitor import Monitor, ResidualTrace
from fdi_torch.monitor.monitor_state import MonitorState
from fdi_torch.monitor.observer_bank import LONG_AGO
from fdi_torch.monitor.samples import Samples, split_at_gaps
from fdi_torch.monitor.sensor_outages import SensorOutages
from fdi_torch.monitor.state_update import advance_observer, drop_old_samples, initial_state
from fdi_torch.monitor.window_estimators import ESTIMATORS, WindowData, WindowEstimate


@dataclass(frozen=True)
class WindowState:
    """observer: observer state and recent samples. next_end: end of the present window, s. alarmed: whether it had an
    alarm. number: of windows fitted.
    """

    observer: MonitorState
    next_end: float
    alarmed: bool = False
    number: int = 0


class WindowMonitor:
    """The faults and the detector of a monitor, with windows of `length` s, each `stride` s after the previous one.

    estimator: a key of `ESTIMATORS`; each window starts from the previous estimate. If a channel is constant, its
    correlation is undefined and the search maximizes the likelihood instead. Raises ValueError for invalid settings.
    """

    def __init__(self, monitor: Monitor, estimator: str, length: float, stride: float | None = None) -> None:
        if estimator not in ESTIMATORS:
            raise ValueError(f"expected an estimator of {', '.join(ESTIMATORS)}, got '{estimator}'")
        if not length > 0 or (stride is not None and not 0 < stride <= length):
            raise ValueError(
                f"expected a window longer than 0 s and a stride within it, got {length:g} s and {stride} s"
            )
        self.space, self.detector, self.watched = monitor.space, monitor.detector, monitor.watched
        self._observer, self._interval = monitor.observer, monitor.noise.interval
        self.estimator, self.length, self.stride = estimator, length, length if stride is None else stride

    def start(self, samples: Samples, believed: Tensor | None = None, levels: Tensor | None = None) -> WindowState:
        """The state after the first sample."""
        theta = self.space.nominal() if believed is None else believed
        state = initial_state(self._observer, samples, theta, theta, levels=levels)
        return WindowState(state, state.reachable + self.length)

    def advance(
        self, state: WindowState, samples: Samples, show: Callable[[ResidualTrace], None] | None = None
    ) -> tuple[WindowState, list[Event]]:
        """Process further samples as `Monitor.advance` does: alarms, and an estimate at the end of each window."""
        events: list[Event] = []
        segments, clock = split_at_gaps(state.observer.clock, samples, self._interval)
        for segment, notice in segments:
            if notice:
                events.append(self._event(state.observer, float(segment.time[0]), "notice", notice))
                fresh = replace(self.start(segment.segment(0, 1), state.observer.believed), number=state.number)
                state, told = self._with_outages(fresh, segment.segment(0, 1), state.observer.outages)
                events += told
                segment = segment.segment(1, len(segment))
            while len(segment):
                due = segment.time >= state.next_end
                count = int(due.to(torch.int8).argmax()) + 1 if bool(due.any()) else len(segment)
                state, new_events = self._process(state, segment.segment(0, count), show)
                events += new_events
                segment = segment.segment(count, len(segment))
        return replace(state, observer=replace(state.observer, clock=clock)), events

    def close(self, state: WindowState) -> list[Event]:
        """No events at the end of the recording."""
        return []

    def _process(
        self, state: WindowState, samples: Samples, show: Callable[[ResidualTrace], None] | None
    ) -> tuple[WindowState, list[Event]]:
        moved, count, events = advance_observer(self._observer, state.observer, samples), len(samples), []
        statistic, memory = self.detector.update(moved.white[-count:], state.observer.detector_memory)
        moved = replace(moved, detector_memory=memory)
        if show is not None:
            show(ResidualTrace(samples.time, moved.residual[-count:], statistic))
        above = statistic > self.detector.threshold
        if not state.alarmed and bool(above.any()):
            when = float(samples.time[int(above.to(torch.int8).argmax())])
            events.append(self._event(moved, when, "alarm", "the residual leaves its fault-free range"))
        alarmed, fewest = state.alarmed or bool(above.any()), self._observer.whitening.order + 1
        state = replace(
            state,
            observer=drop_old_samples(replace(moved, earliest_start=moved.now - 2.0 * self.length), fewest),
            alarmed=alarmed,
        )
        state, notices = self._with_outages(state, samples, moved.outages)
        events = sorted([*notices, *events], key=lambda event: event.time)
        if moved.now < state.next_end:
            return state, events
        state, event = self._estimate(state)
        return state, [*events, event]

    def _with_outages(
        self, state: WindowState, samples: Samples, before: SensorOutages
    ) -> tuple[WindowState, list[Event]]:
        """The state with the outages of sensors after its last samples, and the notices about them."""
        outages, notices = before.along(samples, LONG_AGO)
        observer = replace(state.observer, outages=outages)
        told = [self._event(observer, float(samples.time[k]), "notice", text) for k, text in notices]
        return replace(state, observer=observer), told

    def _estimate(self, state: WindowState) -> tuple[WindowState, Event]:
        """Fit the window that ends now, and give the estimate to the observer."""
        observer = state.observer
        start = max(observer.now - self.length, observer.reachable)
        first = int((observer.samples.time < start).sum())
        window = observer.samples.segment(first, len(observer.samples))
        fitting = self._fitting(window, observer.believed)
        before = fitting.space.nominal()
        before[: self.watched] = observer.believed[: self.watched]
        estimate = ESTIMATORS[self.estimator](WindowData(fitting, window.readings[None]), before[None], state.number)
        believed = observer.believed.clone()
        believed[: self.watched] = estimate.value[0, : self.watched]
        event = self._estimate_event(estimate, observer.now, start, believed)
        observer = replace(observer, believed=believed, healthy=believed, detector_memory=None)
        return WindowState(observer, state.next_end + self.stride, False, state.number + 1), event

    def _fitting(self, window: Samples, believed: Tensor) -> Fitting:
        """Problem of one window: watched faults and initial levels are free, calibrated constants are fixed."""
        plant = self._observer.network.description
        recording = plant.recording(window.time, window.inputs, window.readings, hold=window.hold)
        fitting = set_up(plant, [recording], self.space.parameters[: self.watched], "free")
        network = fitting.networks[0]
        for name, value in zip(self.space.names[self.watched :], believed[self.watched :].tolist(), strict=True):
            if name in network.constants:
                network.nominal[network.constants.index(name)] = value
        return fitting

    def _estimate_event(self, estimate: WindowEstimate, now: float, start: float, believed: Tensor) -> Event:
        rows = zip(self.space.parameters, estimate.value[0].tolist(), estimate.std[0].tolist(), strict=False)
        sizes = [size_of(*row) for row in list(rows)[: self.watched]]
        text = f"{', '.join(s.shown for s in sizes)}; from {start:g} s to {now:g} s"
        return Event(
            now, "estimate", text, explanations=(Explanation(1.0, tuple(sizes)),), believed=self._off_nominal(believed)
        )

    def _event(self, state: MonitorState, time: float, kind: Kind, text: str) -> Event:
        return Event(time, kind, text, believed=self._off_nominal(state.believed))

    def _off_nominal(self, believed: Tensor) -> tuple[tuple[str, float], ...]:
        rows = list(zip(self.space, believed.tolist(), strict=True))[: self.watched]
        return tuple((p.name, value) for p, value in rows if value != p.nominal)
