"""The monitor along a recording or a growing file: every sample, event and belief into a log as it comes."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from fdi_torch.config.growing import Row, growing_rows
from fdi_torch.config.loaded_recordings import read_recording
from fdi_torch.config.monitor import MonitorRun
from fdi_torch.jobs.arrived import reaching, recording_of, samples_of
from fdi_torch.jobs.log_paths import free_path
from fdi_torch.logbook import Listener, RunLog
from fdi_torch.monitor.arrivals import Arrivals, Punctuality
from fdi_torch.monitor.events import Event
from fdi_torch.monitor.following import MonitorState
from fdi_torch.monitor.online import Monitor, Seen
from fdi_torch.monitor.prepare import Prepared, fault_free_part, prepare
from fdi_torch.monitor.samples import Samples, take
from fdi_torch.monitor.windows import WindowMonitor, WindowState
from fdi_torch.parameters import ParameterSpace
from fdi_torch.recording import Recording

CHUNK = 2048  # samples of a recording that are taken at a time


@dataclass(frozen=True)
class Watched:
    """events: how many. lasted, spent: seconds of recording, and of work. log: where all of it lies."""

    events: int
    lasted: float
    spent: float
    log: Path


@dataclass(frozen=True)
class Listening:
    """Who hears what while it happens. tell(share, text): progress. event: each event. ready: what was learnt."""

    tell: Callable[[float, str], None]
    event: Callable[[Event], None]
    ready: Callable[[Prepared], None]
    log: Listener | None = None


def watch(run: MonitorRun, listening: Listening, follow: bool = False, idle: float = 60.0) -> Watched:
    """Prepares a monitor from the fault-free part and follows the recording, or with `follow` the file as it grows.

    What was logged before an error or Ctrl-C stays. idle: s without a sample after which a growing file has ended.
    """
    listening.tell(0.0, "reading")
    path = free_path(Path(run.config.output.folder), run.name)
    whole = None if follow else read_recording(run.config.recording, run.plant, run.base)
    data = [] if whole is None else [{"path": whole.source, "sha256": whole.sha256}]
    seeds = {"seed": run.config.seed}
    with RunLog(
        path, "monitor", config_text=run.text, config=run.resolved, seeds=seeds, data=data, listener=listening.log
    ) as log:
        watcher = _Watcher(run, log, listening)
        try:
            if whole is None:
                _follow(run, watcher, listening, idle)
            else:
                _along(run, watcher, listening, whole)
        finally:
            log.result({"events": watcher.events, "faults": watcher.faults()})
    return Watched(watcher.events, watcher.lasted, watcher.spent, path)


def _along(run: MonitorRun, watcher: _Watcher, listening: Listening, whole: Recording) -> None:
    """A recording that is all there."""
    watcher.begin(_prepared(run, whole))
    samples = take(whole, run.plant)
    lasts, reach = float(whole.time[-1] - whole.time[0]), run.config.window.longest
    if reach > lasts and run.config.mode != "changes":
        raise ValueError(
            f"expected a recording of at least one window ({reach:g} s) for the mode '{run.config.mode}', "
            f"got {lasts:g} s; shorten window.longest"
        )
    if reach > lasts:
        watcher.say(f"windows may reach back {reach:g} s, the recording lasts {lasts:g} s: they end at its beginning")
    for first in range(0, len(samples), CHUNK):
        last = min(first + CHUNK, len(samples))
        watcher.take(samples.stretch(first, last))
        listening.tell(last / len(samples), f"{float(samples.time[last - 1]):g} s")


def _follow(run: MonitorRun, watcher: _Watcher, listening: Listening, idle: float) -> None:
    """As samples arrive; those until the end of the fault-free part are waited for first."""
    arrivals = Arrivals(growing_rows(run.config.recording, run.plant, run.base, idle))
    early: list[Row] = []
    said: list[str] = []
    learnt: list[Row] = []
    for batch in arrivals:
        early += [row for row in batch if not isinstance(row, str)]
        said += [row for row in batch if isinstance(row, str)]
        listening.tell(
            0.0, f"{early[-1][0]:g} s, learning until {run.config.fault_free[1]:g} s" if early else "waiting"
        )
        learnt = reaching(early, run.config.fault_free[1])
        if learnt:
            break
    watcher.begin(_prepared(run, recording_of(learnt or early, run)))
    punctual = Punctuality(time.monotonic)
    first: list[Row | str] = [*said, *early]
    for batch in chain([first], arrivals):
        rows = [row for row in batch if not isinstance(row, str)]
        notices = [row for row in batch if isinstance(row, str)]
        notices += punctual.arrived([row[0] for row in rows]) if rows else []
        for notice in notices:
            watcher.say(notice)
        if rows:
            if watcher.take(samples_of(rows, run)):
                punctual.restarted()
            for notice in punctual.handled(rows[-1][0]):
                watcher.say(notice)
            listening.tell(0.5, f"{rows[-1][0]:g} s")


class _Watcher:
    """A monitor at work, its state, and the log of what it sees."""

    monitor: Monitor | WindowMonitor
    believed: Tensor

    def __init__(self, run: MonitorRun, log: RunLog, listening: Listening) -> None:
        self.run, self.plant, self.log, self.listening = run, run.plant, log, listening
        self.state: Any = None
        self.events, self.spent = 0, 0.0
        self._told: dict[str, float] = {}
        self._began: float | None = None
        self._now = run.config.fault_free[0]

    def begin(self, prepared: Prepared) -> None:
        """What was learnt is told, and so is what speaks against it."""
        inner, config = prepared.monitor, self.run.config
        self.monitor, self.believed = inner, prepared.believed
        if config.mode != "changes":
            window = config.window
            self.monitor = WindowMonitor(
                inner.observer, inner.detector, inner.watched, config.mode, window.longest, window.stride
            )
        self.listening.ready(prepared)
        for doubt in prepared.doubts:
            self.say(doubt)

    @property
    def space(self) -> ParameterSpace:
        return self.monitor.space

    @property
    def lasted(self) -> float:
        """Seconds of plant time from the first sample to the last."""
        return 0.0 if self._began is None else self._now - self._began

    def take(self, samples: Samples) -> bool:
        """Some further samples; whether the observer had to start afresh among them."""
        start = time.monotonic()
        self._log_samples(samples)
        if self.state is None:
            self.state, self._began = self.monitor.start(samples, self.believed), float(samples.time[0])
            samples = samples.stretch(1, len(samples))
        events: list[Event] = []
        if len(samples):
            seen: list[Seen] = []
            try:
                self.state, events = self.monitor.advance(self.state, samples, seen.append)
            finally:  # all at once, in a third of the time
                self._log_seen(seen)
            self._now = float(samples.time[-1])
        for event in events:
            self._tell(event)
        self.spent += time.monotonic() - start
        return any(event.kind == "notice" for event in events)

    def say(self, text: str) -> None:
        """A notice that is not about the plant."""
        self._tell(Event(self._now, "notice", text))

    def faults(self) -> list[str]:
        """What is believed to be off nominal now."""
        return [] if self.state is None else list(self._off_nominal(self.state))

    def _off_nominal(self, state: MonitorState | WindowState) -> dict[str, float]:
        values = zip(self.space, state.believed.tolist(), strict=True)
        return {p.name: value for p, value in list(values)[: self.monitor.watched] if value != p.nominal}

    def _tell(self, event: Event) -> None:
        self.events += 1
        numbers: dict[str, Any] = {
            "faults": list(event.faults) or None,
            "sizes": list(event.sizes) or None,
            "stds": list(event.stds) or None,
            "onset": event.onset,
            "onset_std": event.onset_std,
            "delay": event.delay,
            "incipient": event.incipient if event.faults else None,
            "rivals": list(event.rivals) or None,
        }
        self.log.alarm(event.time, event.kind, " + ".join(event.faults), event.text, **numbers)
        if event.faults and self.state is not None:
            self._log_beliefs(event, self.state)
        self.log.flush()
        self.listening.event(event)

    def _log_beliefs(self, event: Event, state: MonitorState | WindowState) -> None:
        """Each fault that is believed in now, and each that no longer is."""
        now, stds = self._off_nominal(state), dict(zip(event.faults, event.stds, strict=True))
        for name in dict.fromkeys([*self._told, *now]):
            place, _, fault = name.partition(".")
            size = now.get(name, self.space[name].nominal)
            numbers: dict[str, Any] = {"size": size, "size_std": stds.get(name), "unit": self.space[name].unit}
            self.log.fault(fault, place, name in now, t=event.time, **numbers)
        self._told.update(now)

    def _log_samples(self, samples: Samples) -> None:
        plant = self.plant
        sensors = plant.sensors
        self.log.recording(
            samples.time,
            samples.inputs,
            torch.nan_to_num(samples.readings, nan=float("nan")),
            plant.channels(),
            [s.column for s in sensors],
            list(plant.channel_units().values()),
            [s.unit for s in sensors],
            mask=torch.isfinite(samples.readings),
            hold=samples.hold,
        )

    def _log_seen(self, seen: Sequence[Seen]) -> None:
        """Residuals, and the one statistic of all channels beside its threshold."""
        if not seen:
            return
        names, units = [s.column for s in self.plant.sensors], [s.unit for s in self.plant.sensors]
        chart = self.monitor.detector.chart
        time, residual, statistic = (
            torch.cat(parts) for parts in zip(*((s.time, s.residual, s.statistic) for s in seen), strict=True)
        )
        limit = torch.full_like(statistic, self.monitor.detector.threshold)
        residual = torch.cat([part.residual for part in seen])
        table = torch.cat([residual, torch.stack([statistic, limit], dim=1)], dim=1)
        names += [f"{chart}_statistic", f"{chart}_threshold"]
        self.log.samples("/observer/residual", time, table, names, [*units, "", ""])


def _prepared(run: MonitorRun, whole: Recording) -> Prepared:
    c = run.config
    part = fault_free_part(whole, *c.fault_free)
    # Levels that are known at the recording's start are those of no later moment.
    at_start = float(part.time[0]) == float(whole.time[0])
    return prepare(
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
        c.observer.wish(),
    )
