"""The state that a monitor carries from sample to sample: recent samples, observer, alarms, faults."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from torch import Tensor

from fdi_torch.monitor.alarm_state import Alarm
from fdi_torch.monitor.hypothesis import HypothesisFit
from fdi_torch.monitor.law_errors import LawErrors
from fdi_torch.monitor.observer_bank import LONG_AGO, ObserverWindow
from fdi_torch.monitor.samples import ClockState, Samples
from fdi_torch.monitor.sensor_outages import SensorOutages


@dataclass(frozen=True)
class FaultTrack:
    """The size of a known fault over time.

    column: of the parameter space. number: of its alarm. onset, onset_std: s. first, last: (time in s, size, standard
    deviation) of the first and the latest estimate. effect_rms: root mean square of what the fault adds to the white
    residuals. announced: when its size was last announced, s. adjusted: onset of the latest change of size, s.
    """

    column: int
    number: int
    onset: float
    onset_std: float
    first: tuple[float, float, float]
    last: tuple[float, float, float]
    effect_rms: float
    announced: float
    adjusted: float = LONG_AGO

    @property
    def rate(self) -> float | None:
        """Growth between the two estimates, per s; None if they differ by less than three standard deviations."""
        (t0, size0, std0), (t1, size1, std1) = self.first, self.last
        significant = t1 > t0 and abs(size1 - size0) > 3.0 * math.hypot(std0, std1)
        return (size1 - size0) / (t1 - t0) if significant else None

    def moved(self, by: float) -> FaultTrack:
        """The track by a clock that is this much ahead, s."""
        return replace(
            self,
            onset=self.onset + by,
            first=(self.first[0] + by, *self.first[1:]),
            last=(self.last[0] + by, *self.last[1:]),
            announced=self.announced + by,
            adjusted=self.adjusted + by,
        )

    def at(self, time: float) -> tuple[float, float]:
        """Size and standard deviation at a time, s: those of the latest estimate, grown since at the same rate."""
        (t0, _, std0), (t1, size, std) = self.first, self.last
        if self.rate is None:
            return size, std
        ahead = time - t1
        return size + self.rate * ahead, math.hypot(std, ahead / (t1 - t0) * math.hypot(std0, std))


@dataclass(frozen=True)
class HiddenFault:
    """A fault that seems to have ended while the readings could not show it, as a leak of a dry tank.

    track: before it ended. size: before it ended. ended: not before, s. seen: until when the readings were examined, s.
    """

    track: FaultTrack
    size: float
    ended: float
    seen: float

    def moved(self, by: float) -> HiddenFault:
        """The fault by a clock that is this much ahead, s."""
        return replace(self, track=self.track.moved(by), ended=self.ended + by, seen=self.seen + by)


@dataclass(frozen=True)
class DetectedChange:
    """The latest detected change of parameters.

    number: of its alarm. before (P,): the parameters before the change, valid since `since` s. explanations: all with
    more than 0.1 % of the posterior probability, likeliest first; the observer uses the first. alarm_time: s. next_fit:
    when all explanations are fitted again, s. ended: tracks of the faults that recovered at this change. reported:
    parameter names of each explanation in the last event.
    """

    number: int
    before: Tensor
    since: float
    explanations: tuple[HypothesisFit, ...]
    alarm_time: float
    next_fit: float
    ended: tuple[FaultTrack, ...] = ()
    reported: tuple[tuple[str, ...], ...] = ()

    @property
    def best(self) -> HypothesisFit:
        """The likeliest explanation that changes a parameter."""
        return self.explanations[0]


@dataclass(frozen=True)
class PendingAlarm:
    """An alarm that is not isolated yet. attempts: how often isolation has failed."""

    number: int
    attempts: int = 0


@dataclass(frozen=True)
class MonitorState:
    """State of a monitor after a sample.

    Recent samples, S of them:
      samples; state (S, tanks + M): observer state after each, levels in m, then memory of actuators and sensors;
      residual, innovations, white, tested (S, sensors): residuals, innovations of the flow filter, white residuals, and
      what the errors of the known faults leave of these; memory (S, G): state of the flow filter. errors: of the known
      faults after the last sample. number: samples since the observer's start. reachable: when it started, s.
      earliest_start: no later window begins before it, s.
    Parameters:
      believed (P,): values that the observer uses; healthy (P,): the same with every fault at nominal.
    Bookkeeping:
      clock: time of the last sample. outages: of the sensors. detector_memory: None after a restart of the detector.
      alarms: all so far. pending: the alarm that is not isolated yet. change: the latest. tracks: the known faults.
      hidden: faults whose end the readings have not shown yet. learning_until: no alarm is raised before it, s.
    """

    samples: Samples
    state: Tensor
    residual: Tensor
    innovations: Tensor
    white: Tensor
    tested: Tensor
    memory: Tensor
    errors: LawErrors
    number: int
    believed: Tensor
    healthy: Tensor
    reachable: float
    clock: ClockState
    outages: SensorOutages
    earliest_start: float = LONG_AGO
    detector_memory: Tensor | None = None
    alarms: tuple[Alarm, ...] = ()
    pending: PendingAlarm | None = None
    change: DetectedChange | None = None
    tracks: tuple[FaultTrack, ...] = ()
    hidden: tuple[HiddenFault, ...] = ()
    learning_until: float = LONG_AGO

    @property
    def adjusted(self) -> float:
        """Onset of the latest change of a known fault's size, s."""
        return max((t.adjusted for t in self.tracks), default=LONG_AGO)

    def alarm(self, number: int) -> Alarm:
        return self.alarms[number - 1]

    def with_alarm(self, alarm: Alarm) -> MonitorState:
        return replace(self, alarms=tuple(alarm if a.number == alarm.number else a for a in self.alarms))

    @property
    def now(self) -> float:
        """Time of the last sample, s."""
        return float(self.samples.time[-1])

    @property
    def valid_since(self) -> float:
        """Since when the observer's present parameters have applied, s."""
        last = self.change.best.onset if self.change is not None else self.reachable
        return max(self.reachable, last, self.adjusted)

    @property
    def off_nominal(self) -> Tensor:
        """Which parameters have a value other than fault-free, (P,) bool."""
        return self.believed != self.healthy

    def window(self, start: float) -> ObserverWindow:
        """The window from the last sample before `start` s; it holds at least two further samples."""
        start = max(start, self.earliest_start)
        first = max(min(int((self.samples.time < start).sum()) - 1, len(self.samples) - 3), 0)
        processed = self.number - (len(self.samples) - 1 - first)
        samples = self.samples.segment(first, len(self.samples))
        return ObserverWindow(samples, self.state[first], processed, self.memory[first])
