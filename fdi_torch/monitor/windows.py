"""The paper's adaptive observer (16): window after window all faults are fitted, and go back into the observer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.estimate.fitting import Fitting, set_up
from fdi_torch.monitor.change import ChangedObserver
from fdi_torch.monitor.detection import Detector
from fdi_torch.monitor.events import Event, Explanation, Kind, Size, amount
from fdi_torch.monitor.following import MonitorState, begin, forget, observe
from fdi_torch.monitor.monitor import Seen
from fdi_torch.monitor.samples import Samples, continuous
from fdi_torch.monitor.window_fit import ESTIMATORS, WindowData, WindowEstimate
from fdi_torch.parameters import ParameterSpace
from fdi_torch.recording import Recording


@dataclass(frozen=True)
class WindowState:
    """following: the observer and what it saw. next_end: of the window at work, s. alarmed: whether an alarm was told
    in it. number: of windows fitted.
    """

    following: MonitorState
    next_end: float
    alarmed: bool = False
    number: int = 0

    @property
    def believed(self) -> Tensor:
        return self.following.believed


class WindowMonitor:
    """Follows one plant in windows of `length` s, each beginning `stride` s after the one before it.

    estimator: of `ESTIMATORS`; each window begins with the last one's estimate. Where a channel stands still its
    correlation is undefined, and the search takes the likelihood. Raises ValueError for what cannot be.
    """

    def __init__(
        self,
        observer: ChangedObserver,
        detector: Detector,
        watched: int,
        estimator: str,
        length: float,
        stride: float | None = None,
        interval: float = 1.0,
    ) -> None:
        if estimator not in ESTIMATORS:
            raise ValueError(f"expected an estimator of {', '.join(ESTIMATORS)}, got '{estimator}'")
        if not length > 0 or (stride is not None and not 0 < stride <= length):
            raise ValueError(
                f"expected a window longer than 0 s and a stride within it, got {length:g} s and {stride} s"
            )
        self._observer, self.detector, self.watched, self._interval = observer, detector, watched, interval
        self.estimator, self.length, self.stride = estimator, length, length if stride is None else stride

    @property
    def space(self) -> ParameterSpace:
        return self._observer.space

    def start(self, samples: Samples, believed: Tensor | None = None, levels: Tensor | None = None) -> WindowState:
        """The state after the first of some samples."""
        theta = self.space.nominal() if believed is None else believed
        state = begin(self._observer, samples, theta, theta, levels)
        return WindowState(state, state.reachable + self.length)

    def advance(
        self, state: WindowState, samples: Samples, show: Callable[[Seen], None] | None = None
    ) -> tuple[WindowState, list[Event]]:
        """As `Monitor.advance`: alarms as they come, and an estimate at the end of each window."""
        events: list[Event] = []
        stretches, arrived = continuous(state.following.arrived, samples, self._interval)
        for stretch, notice in stretches:
            if notice:
                events.append(Event(float(stretch.time[0]), "notice", notice, believed=self._off(state.believed)))
                state = replace(self.start(stretch, state.believed), number=state.number)
                stretch = stretch.stretch(1, len(stretch))
            while len(stretch):
                due = stretch.time >= state.next_end
                count = int(due.to(torch.int8).argmax()) + 1 if bool(due.any()) else len(stretch)
                state, news = self._take(state, stretch.stretch(0, count), show)
                events += news
                stretch = stretch.stretch(count, len(stretch))
        return replace(state, following=replace(state.following, arrived=arrived)), events

    def close(self, state: WindowState) -> list[Event]:
        """Nothing is left to be said at the end."""
        return []

    def _take(
        self, state: WindowState, samples: Samples, show: Callable[[Seen], None] | None
    ) -> tuple[WindowState, list[Event]]:
        moved, count, events = observe(self._observer, state.following, samples), len(samples), []
        statistic, charted = self.detector.follow(moved.white[-count:], state.following.charted)
        moved = replace(moved, charted=charted)
        if show is not None:
            show(Seen(samples.time, moved.residual[-count:], statistic))
        above = statistic > self.detector.threshold
        if not state.alarmed and bool(above.any()):
            when = float(samples.time[int(above.to(torch.int8).argmax())])
            events.append(self._event(moved, when, "alarm", "the residual leaves its fault-free range"))
        alarmed = state.alarmed or bool(above.any())
        state = replace(state, following=forget(replace(moved, floor=moved.now - 2.0 * self.length)), alarmed=alarmed)
        if moved.now < state.next_end:
            return state, events
        state, event = self._estimate(state)
        return state, [*events, event]

    def _estimate(self, state: WindowState) -> tuple[WindowState, Event]:
        """The window that ends now, fitted; the observer goes on with what was found."""
        following = state.following
        start = max(following.now - self.length, following.reachable)
        first = int((following.samples.time < start).sum())
        window = following.samples.stretch(first, len(following.samples))
        fitting = self._fitting(window, following.believed)
        before = fitting.space.nominal()
        before[: self.watched] = following.believed[: self.watched]
        found = ESTIMATORS[self.estimator](WindowData(fitting, window.readings[None]), before[None], state.number)
        believed = following.believed.clone()
        believed[: self.watched] = found.value[0, : self.watched]
        event = self._tell(found, following.now, start, believed)
        following = replace(following, believed=believed, healthy=believed, charted=None)
        return WindowState(following, state.next_end + self.stride, False, state.number + 1), event

    def _fitting(self, window: Samples, believed: Tensor) -> Fitting:
        """The window with the watched faults and its start levels; calibrated constants as they are believed to be."""
        plant = self._observer.network.description
        recording = Recording(
            window.time,
            window.inputs,
            window.readings,
            plant.channels(),
            tuple(sensor.column for sensor in plant.sensors),
            tuple(plant.channel_units().values()),
            tuple(sensor.unit for sensor in plant.sensors),
            hold=window.hold,
        )
        fitting = set_up(plant, [recording], self.space.parameters[: self.watched], "free")
        network = fitting.networks[0]
        for name, value in zip(self.space.names[self.watched :], believed[self.watched :].tolist(), strict=True):
            network.nominal[network.constants.index(name)] = value
        return fitting

    def _tell(self, found: WindowEstimate, now: float, start: float, believed: Tensor) -> Event:
        rows = zip(self.space.parameters, found.value[0].tolist(), found.std[0].tolist(), strict=False)
        sizes = [Size(p.name, v, s, p.unit, amount(p, v, s)) for p, v, s in list(rows)[: self.watched]]
        text = f"{', '.join(s.shown for s in sizes)}; from {start:g} s to {now:g} s"
        return Event(
            now, "estimate", text, explanations=(Explanation(1.0, tuple(sizes)),), believed=self._off(believed)
        )

    def _event(self, state: MonitorState, time: float, kind: Kind, text: str) -> Event:
        return Event(time, kind, text, believed=self._off(state.believed))

    def _off(self, believed: Tensor) -> tuple[tuple[str, float], ...]:
        rows = list(zip(self.space, believed.tolist(), strict=True))[: self.watched]
        return tuple((p.name, value) for p, value in rows if value != p.nominal)
