"""A monitor together with its log: samples, residuals, events and estimated faults, in the order of the samples.

A sample is followed by its residual and by the events that it causes. The log therefore does not depend on how many
samples are processed at once.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Container, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from typing import Any

import torch
from torch import Tensor

from fdi_torch.amounts import faults_in_words
from fdi_torch.config.monitor_file import MonitorRun
from fdi_torch.config.problems import naming, naming_source
from fdi_torch.gap.preprocess.acquisition import usable
from fdi_torch.jobs.monitor_rows import CLOCK, FROM_SOURCE, event_fields, samples_of_rows
from fdi_torch.live.row_buffer import Row
from fdi_torch.logbook import Listener, RunLog, as_array
from fdi_torch.monitor.diagnosability import diagnosability
from fdi_torch.monitor.events import Event
from fdi_torch.monitor.monitor import Monitor, ResidualTrace
from fdi_torch.monitor.monitor_setup import PreparedMonitor, fault_free_part, prepare_monitor
from fdi_torch.monitor.samples import Samples, samples_of_recording
from fdi_torch.monitor.window_monitor import WindowMonitor
from fdi_torch.parameters import ParameterName, ParameterSpace
from fdi_torch.plant.description import PlantDescription
from fdi_torch.progress import Tell, silent
from fdi_torch.recording import Recording
from fdi_torch.recordings.check import data_warnings

CHUNK = 2048  # samples of a recording that are processed at a time


@dataclass(frozen=True)
class MonitorCallbacks:
    """Functions called during a run. tell(share, text): progress. event: each new event. ready: the prepared monitor.

    log: receives every log message. note(text): whether the run continues an earlier one, or could.
    """

    tell: Tell = silent
    event: Callable[[Event], None] = lambda event: None
    ready: Callable[[PreparedMonitor], None] = lambda prepared: None
    log: Listener | None = None
    note: Callable[[str], None] = lambda text: None


class LoggedMonitor:
    """A running monitor with its state and its log.

    reported: count of each event in an earlier log of the same run; these events are not passed to the callback again.
    """

    monitor: Monitor | WindowMonitor
    believed: Tensor

    def __init__(
        self,
        run: MonitorRun,
        log: RunLog,
        callbacks: MonitorCallbacks,
        reported: Counter[tuple[Any, ...]] | None = None,
    ) -> None:
        self.run, self.plant, self.log, self.callbacks = run, run.plant, log, callbacks
        self._reported = Counter() if reported is None else reported
        self.state: Any = None
        self.events, self.alarms, self.spent = 0, 0, 0.0
        self._ever_suspected: dict[str, None] = {}
        self._present_faults: tuple[tuple[str, float], ...] = ()
        self._first_time: float | None = None
        self._now = run.config.fault_free[0]

    def process_recording(self, whole: Recording) -> None:
        """Learn from the fault-free part of a complete recording, and process all of it. Raises ValueError if nothing
        is left to watch."""
        self.learn(whole, float(whole.time[-1]))
        samples = samples_of_recording(whole, self.run.plant)
        duration, window = float(whole.time[-1] - whole.time[0]), self.run.config.window.longest
        if window > duration and self.run.config.mode != "changes":
            raise ValueError(
                f"expected a recording of at least one window ({window:g} s) for the mode '{self.run.config.mode}', "
                f"got {duration:g} s; shorten window.longest"
            )
        for first in range(0, len(samples), CHUNK):
            last = min(first + CHUNK, len(samples))
            self.process(samples.segment(first, last))
            self.callbacks.tell(last / len(samples), f"{float(samples.time[last - 1]):g} s")

    def learn(self, whole: Recording, end: float = math.inf) -> None:
        """Prepare the monitor from the fault-free part, and report what was learnt and any warnings.

        end: of all samples, s, if no further ones will come.
        """
        prepared, config = _prepare(self.run, whole, end), self.run.config
        self.monitor, self.believed = prepared.monitor, prepared.believed
        if config.mode != "changes":
            window = config.window
            self.monitor = WindowMonitor(prepared.monitor, config.mode, window.longest, window.stride)
        self.callbacks.ready(prepared)
        self._now = config.fault_free[1]
        self._report(Event(self._now, "watching", prepared.false_alarm_text))
        for text in self._watched_faults_texts(prepared, whole):
            self.notice(text)
        part = fault_free_part(whole, *config.fault_free)
        for warning in (*data_warnings(part, self.plant), *prepared.warnings):
            self.notice(warning)

    def process_items(self, items: Iterable[Row | str]) -> bool:
        """Process rows, and notices of their source, in order. Returns whether the observer had to restart."""
        restarted = False
        for is_notice, group in groupby(items, lambda item: isinstance(item, str)):
            if is_notice:
                for text in group:
                    self.notice(str(text), from_source=True)
            else:
                rows = [row for row in group if not isinstance(row, str)]
                restarted |= self.process(samples_of_rows(rows, self.run))
        return restarted

    def process(self, samples: Samples) -> bool:
        """Process further samples. Returns whether the observer had to restart."""
        start = time.monotonic()
        traces: list[ResidualTrace] = []
        events: list[Event] = []
        further = samples
        if self.state is None:
            self.state, self._first_time = self._start(samples), float(samples.time[0])
            further = samples.segment(1, len(samples))
        try:
            if len(further):
                self.state, events = self.monitor.advance(self.state, further, traces.append)
        finally:
            self._log_in_order(samples, traces, events)
        self._now = float(samples.time[-1])
        self.spent += time.monotonic() - start
        return any(event.kind == "notice" for event in events)

    def log_origin(self, origin: float) -> None:
        """Log time 0 of a live source or growing file, s since 1970, with which a resumed run goes on."""
        self.log.write(CLOCK, {"origin": origin}, self._now)

    def close(self) -> None:
        """Report the summary of each alarm at the end."""
        for event in self.monitor.close(self.state) if self.state is not None else []:
            self._report(event)

    def notice(self, text: str, from_source: bool = False) -> None:
        """Report a notice that is not caused by the plant. from_source: about the delivery of samples."""
        self._report(Event(self._now, "notice", text, believed=self._present_faults), from_source)

    def faults(self) -> list[str]:
        """Names of the parameters that are off nominal at present."""
        return [name for name, _ in self._present_faults]

    @property
    def space(self) -> ParameterSpace:
        return self.monitor.space

    @property
    def lasted(self) -> float:
        """Time from the first sample to the last, s."""
        return 0.0 if self._first_time is None else self._now - self._first_time

    def _watched_faults_texts(self, prepared: PreparedMonitor, whole: Recording) -> tuple[str, ...]:
        """The watched faults, and which of them the inputs of the fault-free part cannot distinguish."""
        names = [self.space.names[fault.size] for fault in prepared.monitor.faults]
        text = f"watches for {', '.join(faults_in_words(names))}"
        part = fault_free_part(whole, *self.run.config.fault_free)
        try:
            report = diagnosability(self.plant, names, part, prepared.monitor.noise.reading_std, start="free")
        except ValueError as error:
            return text, f"which of them can be isolated is unknown: {error}"
        return text, *report.groups

    def _start(self, samples: Samples) -> Any:
        if isinstance(self.monitor, WindowMonitor):
            return self.monitor.start(samples, self.believed)
        return self.monitor.start(samples, self.believed, learning_until=self.run.config.fault_free[1])

    def _report(self, event: Event, from_source: bool = False) -> None:
        """Log an event and the faults after it, and pass it on unless an earlier log of the run has it."""
        self.events += 1
        self.alarms += event.kind == "alarm"
        fields = event_fields(event) | {FROM_SOURCE: from_source or None}
        self.log.alarm(event.time, event.kind, " + ".join(event.faults), event.text, **fields)
        self._present_faults = event.believed
        if event.kind != "notice":
            self._log_faults(event)
        self.log.flush()
        key = event.time, event.kind, event.text
        if self._reported[key] > 0:
            self._reported[key] -= 1
        else:
            self.callbacks.event(event)

    def _log_faults(self, event: Event) -> None:
        """Log each fault that is present, suspected or no longer present at an event."""
        present, masses = dict(event.believed), event.masses
        stds = dict(zip(event.faults, event.stds, strict=True))
        for name in dict.fromkeys([*self._ever_suspected, *present, *masses]):
            at = ParameterName.parse(name)
            numbers: dict[str, Any] = {
                "probability": masses.get(name),
                "size": present.get(name, self.space[name].nominal),
                "size_std": stds.get(name),
                "unit": self.space[name].unit,
            }
            self.log.fault(at.at_place, at.place, name in present, t=event.time, **numbers)
        self._ever_suspected.update(dict.fromkeys([*present, *masses]))

    def _log_in_order(self, samples: Samples, traces: Sequence[ResidualTrace], events: Sequence[Event]) -> None:
        """Log samples, each followed by its residual and its events. The first after a restart has no residual."""
        clock = samples.time.tolist()
        tested = _positions(clock, [(t, True) for trace in traces for t in trace.time.tolist()])
        raised = _positions(clock, [(event.time, event.kind == "notice") for event in events], set(tested))
        residuals = samples.readings.new_full((len(clock), len(self.plant.sensors) + 2), torch.nan)
        if traces:
            residuals[tested] = torch.cat([self._residual_rows(trace) for trace in traces])
        has_residual = torch.zeros(len(clock), dtype=torch.bool)
        has_residual[tested] = True
        changes = (torch.diff(has_residual.to(torch.int8)).nonzero().flatten() + 1).tolist()
        waiting = list(zip(raised, events, strict=True))
        for first, last in pairwise(sorted({0, *changes, *(k + 1 for k in raised), len(clock)})):
            self._log_samples(samples.segment(first, last), residuals[first:last] if has_residual[first] else None)
            while waiting and waiting[0][0] < last:
                self._report(waiting.pop(0)[1])

    def _residual_rows(self, trace: ResidualTrace) -> Tensor:
        """Residuals, the detector's statistic and its threshold, (S, sensors + 2)."""
        threshold = torch.full_like(trace.statistic, self.monitor.detector.threshold)
        return torch.cat([trace.residual, torch.stack([trace.statistic, threshold], dim=1)], dim=1)

    def _log_samples(self, samples: Samples, residuals: Tensor | None) -> None:
        """Log samples, and the rows of `_residual_rows` if they have been tested."""
        units, chart = self.plant.channel_units(), self.monitor.detector.chart
        names, sensor_units = self.plant.outputs(), [s.unit for s in self.plant.sensors]
        mask, readings = samples.readings.isfinite(), torch.nan_to_num(samples.readings, nan=torch.nan)
        signals: list[tuple[Any, ...]] = [
            ("/plant/input", as_array(samples.inputs), list(units), list(units.values()), None, {"hold": samples.hold}),
            ("/plant/output", as_array(readings), names, sensor_units, as_array(mask), None),
        ]
        if residuals is not None:
            columns = [*names, f"{chart}_statistic", f"{chart}_threshold"]
            signals.append(("/observer/residual", as_array(residuals), columns, [*sensor_units, "", ""], None, None))
        self.log.recording_blocks(signals, as_array(samples.time))


def _positions(clock: Sequence[float], times: Sequence[tuple[float, bool]], tested: Container[int] = ()) -> list[int]:
    """Index on the clock of each of the times, in their order. A time with True comes after the previous one, and not
    among `tested`: the clock may jump back, which causes a notice, and each sample has at most one notice."""
    positions, k = [], -1
    for time_of_item, is_later in times:
        k = clock.index(time_of_item, k + 1 if is_later else max(k, 0))
        while is_later and k in tested:
            k = clock.index(time_of_item, k + 1)
        positions.append(k)
    return positions


def _prepare(run: MonitorRun, whole: Recording, end: float) -> PreparedMonitor:
    c = run.config
    with naming_source(run.source), naming("fault_free"):
        part = usable_part(run.plant, fault_free_part(whole, *c.fault_free))
        if end <= c.fault_free[1]:
            raise ValueError(
                f"{whole.source}: expected an end before that of the recording ({end:g} s), got {c.fault_free[1]:g} s; "
                "nothing would be watched: shorten it"
            )
    # The configured initial levels are valid only if the fault-free part starts with the recording.
    at_start = float(part.time[0]) == float(whole.time[0])
    return prepare_monitor(
        run.plant,
        part,
        c.faults,
        c.calibrate,
        c.detector,
        c.false_alarms_every,
        c.window.settings(),
        c.step,
        c.seed,
        c.recording.start_levels if at_start else "free",
        c.ranges,
    )


def usable_part(plant: PlantDescription, part: Recording) -> Recording:
    """The fault-free part. Raises ValueError for wrong units, channels or clocks, and for a stuck sensor."""
    checked = usable(plant, part)
    if checked.stuck:
        raise ValueError(
            f"{part.source}: expected a fault-free part in which the readings of every sensor vary, but "
            f"{checked.stuck[0].text}; choose another part, or leave the sensor out of the plant file"
        )
    return checked.recording
