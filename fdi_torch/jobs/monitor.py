"""The monitor along a recording or a growing file: every sample, event and belief into a log as it comes.

A monitor is a function of the samples so far, to the last bit. Therefore a log needs to keep nothing but these: a run
that was killed goes on by taking them again, which is a thousand times faster than they came.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import orjson
import torch
from torch import Tensor

from fdi_torch.config.growing_recordings import Row, growing_rows
from fdi_torch.config.loaded_recordings import read_recording
from fdi_torch.config.monitor_file import MonitorRun
from fdi_torch.gap.acquisition import usable
from fdi_torch.jobs.arrived import followed_on, logged_rows, reaching, recording_of, samples_of
from fdi_torch.jobs.log_paths import RESUMES, free_path, go_on_from
from fdi_torch.logbook import Listener, RunLog
from fdi_torch.logbook import Run as LoggedRun
from fdi_torch.monitor.arrivals import Arrivals, Punctuality
from fdi_torch.monitor.diagnosability import diagnosability
from fdi_torch.monitor.events import FORMAT, Event
from fdi_torch.monitor.monitor import Monitor, Seen
from fdi_torch.monitor.prepare import Prepared, fault_free_part, prepare
from fdi_torch.monitor.samples import Samples, take
from fdi_torch.monitor.windows import WindowMonitor
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording
from fdi_torch.recordings.check import data_warnings

CHUNK = 2048  # samples of a recording that are taken at a time
ALARM = "/observer/alarm"


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


def watch(
    run: MonitorRun, listening: Listening, follow: bool = False, idle: float = 60.0, resume: bool = False
) -> Watched:
    """Prepares a monitor from the fault-free part and follows the recording, or with `follow` the file as it grows.

    What was logged before an error or Ctrl-C stays. idle: s without a sample after which a growing file has ended.
    resume: goes on from what a killed or interrupted run of the same file logged, and ends as it would have; events
    that it logged are not told again.
    """
    listening.tell(0.0, "reading")
    path, before = _log_to_write(run, resume)
    whole = None if follow else read_recording(run.config.recording, run.plant, run.base, run.given)
    earlier = logged_rows(before, run) if follow and before is not None else []
    told = Counter(_heard(message.payload) for message in before.messages([ALARM])) if before is not None else Counter()
    with RunLog(path, "monitor", **origin_of(run, whole), listener=listening.log, after_interruption=RESUMES) as log:
        watcher = Watcher(run, log, listening, told)
        try:
            if whole is None:
                _follow(run, watcher, listening, idle, earlier)
            else:
                watcher.along(whole)
            watcher.close()
        finally:
            log.result({"events": watcher.events, "faults": watcher.faults()})
    return Watched(watcher.events, watcher.lasted, watcher.spent, path)


def origin_of(run: MonitorRun, whole: Recording | None) -> dict[str, Any]:
    """What a log says of where its run comes from."""
    return {
        "config_text": run.text,
        "config": run.resolved,
        "seeds": {"seed": run.config.seed},
        "data": [] if whole is None else [{"path": whole.source, "sha256": whole.sha256}],
    }


def _log_to_write(run: MonitorRun, resume: bool) -> tuple[Path, LoggedRun | None]:
    folder = Path(run.config.output.folder)
    if not resume:
        return free_path(folder, run.name), None
    found = go_on_from(folder, run.name, run.text)
    if found is None:
        raise ValueError(f"{folder}: expected an unfinished log {run.name}.mcap, got none; start without --resume")
    return found


def _heard(payload: dict[str, Any]) -> tuple[Any, ...]:
    """What makes an event the same one in two logs."""
    return payload["t"], payload["event"], payload["message"]


def _follow(run: MonitorRun, watcher: Watcher, listening: Listening, idle: float, earlier: Sequence[Row]) -> None:
    """As samples arrive; those until the end of the fault-free part are waited for first."""
    source = growing_rows(run.config.recording, run.plant, run.base, idle)
    arrivals = Arrivals(followed_on(earlier, source) if earlier else source)
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
    watcher.learn(recording_of(learnt or early, run))
    punctual = Punctuality(time.monotonic)
    first: list[Row | str] = [*said, *early]
    batches: Iterable[list[Row | str]] = chain([first], arrivals)
    for batch in batches:
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


class Watcher:
    """A monitor at work, its state, and the log of what it sees. told: events that are in an earlier log of the run."""

    monitor: Monitor | WindowMonitor
    believed: Tensor

    def __init__(
        self, run: MonitorRun, log: RunLog, listening: Listening, told: Counter[tuple[Any, ...]] | None = None
    ) -> None:
        self.run, self.plant, self.log, self.listening = run, run.plant, log, listening
        self._told = Counter() if told is None else told
        self.state: Any = None
        self.events, self.spent = 0, 0.0
        self._suspected: dict[str, None] = {}
        self._standing: tuple[tuple[str, float], ...] = ()
        self._began: float | None = None
        self._now = run.config.fault_free[0]

    def along(self, whole: Recording) -> None:
        """A recording that is all there."""
        self.learn(whole)
        samples = take(whole, self.run.plant)
        lasts, reach = float(whole.time[-1] - whole.time[0]), self.run.config.window.longest
        if reach > lasts and self.run.config.mode != "changes":
            raise ValueError(
                f"expected a recording of at least one window ({reach:g} s) for the mode '{self.run.config.mode}', "
                f"got {lasts:g} s; shorten window.longest"
            )
        for first in range(0, len(samples), CHUNK):
            last = min(first + CHUNK, len(samples))
            self.take(samples.stretch(first, last))
            self.listening.tell(last / len(samples), f"{float(samples.time[last - 1]):g} s")

    def learn(self, whole: Recording) -> None:
        """From the fault-free part of a recording. What was learnt is told, and so is what speaks against it."""
        prepared, config = _prepared(self.run, whole), self.run.config
        inner = prepared.monitor
        self.monitor, self.believed = inner, prepared.believed
        if config.mode != "changes":
            window = config.window
            self.monitor = WindowMonitor(
                inner.observer,
                inner.detector,
                inner.watched,
                config.mode,
                window.longest,
                window.stride,
                inner.noise.interval,
            )
        self.listening.ready(prepared)
        self._now = config.fault_free[1]
        self._tell(Event(self._now, "watching", prepared.learnt))
        self.say(self._suspects(prepared, whole))
        part = fault_free_part(whole, *config.fault_free)
        for doubt in (*data_warnings(part, self.plant), *prepared.doubts):
            self.say(doubt)

    def _suspects(self, prepared: Prepared, whole: Recording) -> str:
        """What is watched for, and which of it the inputs of the fault-free part cannot separate."""
        names = [self.space.names[fault.size] for fault in prepared.monitor.faults]
        told = f"watches for {', '.join(names)}"
        part = fault_free_part(whole, *self.run.config.fault_free)
        try:
            report = diagnosability(self.plant, names, part, prepared.noise.reading_std, start="free")
        except ValueError as error:
            return f"{told}; which of them can be told apart is unknown: {error}"
        return "; ".join([told, *report.groups])

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
            self.state, self._began = self._start(samples), float(samples.time[0])
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

    def close(self) -> None:
        """One line for each alarm, when nothing more comes."""
        for event in self.monitor.close(self.state) if self.state is not None else []:
            self._tell(event)

    def say(self, text: str) -> None:
        """A notice that is not about the plant."""
        self._tell(Event(self._now, "notice", text, believed=self._standing))

    def faults(self) -> list[str]:
        """What is believed to be off nominal now."""
        return [name for name, _ in self._standing]

    def _start(self, samples: Samples) -> Any:
        if isinstance(self.monitor, WindowMonitor):
            return self.monitor.start(samples, self.believed)
        return self.monitor.start(samples, self.believed, learning_until=self.run.config.fault_free[1])

    def _tell(self, event: Event) -> None:
        """An event with all it holds. What is believed in at that moment follows it."""
        self.events += 1
        self.log.alarm(event.time, event.kind, " + ".join(event.faults), event.text, **logged(event))
        self._standing = event.believed
        if event.kind != "notice":
            self._log_beliefs(event)
        self.log.flush()
        key = event.time, event.kind, event.text
        if self._told[key] > 0:
            self._told[key] -= 1
        else:
            self.listening.event(event)

    def _log_beliefs(self, event: Event) -> None:
        """Each fault that is believed in at an event, each suspected beside it, and each that no longer is."""
        now, masses, stds = dict(event.believed), event.masses, dict(zip(event.faults, event.stds, strict=True))
        for name in dict.fromkeys([*self._suspected, *now, *masses]):
            place, _, fault = name.partition(".")
            size = now.get(name, self.space[name].nominal)
            numbers: dict[str, Any] = {"size": size, "size_std": stds.get(name), "unit": self.space[name].unit}
            self.log.fault(fault, place, name in now, t=event.time, probability=masses.get(name), **numbers)
        self._suspected.update(dict.fromkeys([*now, *masses]))

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
        table = torch.cat([residual, torch.stack([statistic, limit], dim=1)], dim=1)
        names += [f"{chart}_statistic", f"{chart}_threshold"]
        self.log.samples("/observer/residual", time, table, names, [*units, "", ""])


def _sound(plant: PlantDescription, part: Recording) -> Recording:
    """The fault-free part. Raises ValueError where its units, channels or clocks have slipped, or a sensor is stuck."""
    found = usable(plant, part)
    if found.stuck:
        raise ValueError(
            f"{part.source}: expected a fault-free part in which every sensor reads its level, but "
            f"{found.stuck[0].text}; choose another part, or leave the sensor out of the plant file"
        )
    return found.recording


def logged(event: Event) -> dict[str, Any]:
    """An event's fields as a log takes them: numbers, texts and flat lists, and all of it as JSON in `details`."""
    fields: dict[str, Any] = {
        "alarm": event.alarm or None,
        "state": str(event.state),
        "headline": event.headline if event.explanations else None,
        "faults": list(event.faults) or None,
        "sizes": list(event.sizes) or None,
        "stds": list(event.stds) or None,
        "units": list(event.units) or None,
        "onset": event.onset,
        "onset_std": event.onset_std,
        "delay": event.delay,
        "growing": event.growing if event.faults else None,
        "explanations": [e.words for e in event.explanations] or None,
        "masses": [e.mass for e in event.explanations] or None,
        "sensors": [name for name, _ in event.shares] or None,
        "shares": [share for _, share in event.shares] or None,
        "first": event.first,
        "last": event.last,
        "count": event.count,
        "severity": event.severity or None,
        "announced": event.announced,
        "format": FORMAT,
        "details": orjson.dumps(event.to_dict()).decode(),
    }
    return fields


def _prepared(run: MonitorRun, whole: Recording) -> Prepared:
    c = run.config
    part = _sound(run.plant, fault_free_part(whole, *c.fault_free))
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
