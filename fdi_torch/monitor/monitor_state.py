"""The state that a monitor carries from sample to sample: recent samples, observer, alarms, faults; how it moves on."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.monitor.alarm_state import Alarm
from fdi_torch.monitor.hypothesis import HypothesisFit
from fdi_torch.monitor.observer_bank import LONG_AGO, NEVER, ChangeHypotheses, ObserverBank, ObserverWindow
from fdi_torch.monitor.samples import ClockState, Samples, concatenated


@dataclass(frozen=True)
class FaultTrack:
    """The size of a known fault over time.

    column: of the parameter space. number: of its alarm. onset: s. first, last: (time in s, size, standard deviation)
    of the first and the latest estimate. effect_rms: root mean square of what the fault adds to the white residuals.
    announced: when its size was last announced, s. adjusted: onset of the latest change of size, s.
    """

    column: int
    number: int
    onset: float
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


@dataclass(frozen=True)
class HiddenFault:
    """A fault that seems to have ended, but that the readings since would not show, for example in a dry tank.

    track: before it ended. size: before it ended. ended: s. seen: until when the readings were examined, s.
    """

    track: FaultTrack
    size: float
    ended: float
    seen: float


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

    @property
    def hypothesis(self) -> ChangeHypotheses:
        """The likeliest explanation as the single lane of a bank of observers."""
        best = self.best
        onset, incipient = best.value.new_tensor([best.onset]), torch.tensor([best.hypothesis.incipient])
        return ChangeHypotheses(best.value[None], onset, incipient)


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
      residual, innovations, white (S, sensors): residuals, innovations of the flow filter, and white residuals; memory
      (S, F): state of the flow filter. number: samples since the observer's start. reachable: when it started, s.
      earliest_start: no later window begins before it, s.
    Parameters:
      believed (P,): values that the observer uses; healthy (P,): the same with every fault at nominal.
    Bookkeeping:
      clock: time of the last sample. detector_memory: None after a restart of the detector. alarms: all so far.
      pending: the alarm that is not isolated yet. change: the latest. tracks: the known faults. hidden: faults whose
      end the readings have not shown yet. learning_until: no alarm is raised before it, s.
    """

    samples: Samples
    state: Tensor
    residual: Tensor
    innovations: Tensor
    white: Tensor
    memory: Tensor
    number: int
    believed: Tensor
    healthy: Tensor
    reachable: float
    clock: ClockState
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


def initial_state(
    observer: ObserverBank, samples: Samples, believed: Tensor, healthy: Tensor, levels: Tensor | None = None
) -> MonitorState:
    """The state after the first sample. levels (tanks,) m: taken from the readings if None."""
    first = samples.segment(0, 1)
    state, residual = observer.first_state(samples, believed, levels)
    innovations, memory = observer.whitening.innovations(residual[None])
    now = float(first.time[0])
    return MonitorState(
        samples=first,
        state=state[None],
        residual=residual[None],
        innovations=innovations,
        white=observer.whitening.of_innovations(innovations),
        memory=memory,
        number=1,
        believed=believed,
        healthy=healthy,
        reachable=now,
        clock=ClockState(now),
    )


def advance_observer(observer: ObserverBank, state: MonitorState, samples: Samples) -> MonitorState:
    """Run the observer along further samples."""
    last = len(state.samples) - 1
    further = concatenated(state.samples.segment(last, last + 1), samples)
    window = ObserverWindow(further, state.state[-1], state.number, state.memory[-1])
    state = replace(state, samples=concatenated(state.samples, samples), number=state.number + len(samples))
    return _run(observer, state, window, state.believed, NEVER)


def adopt_change(observer: ObserverBank, state: MonitorState, change: DetectedChange, believed: Tensor) -> MonitorState:
    """Run the observer again from the change's onset with new parameters (P,), and restart the detector."""
    fit = change.best
    window = state.window(fit.onset)
    state = replace(state, believed=believed, change=change, pending=None, detector_memory=None)
    return _run(observer, state, window, change.before, fit.onset, fit.hypothesis.incipient)


def adopt_sizes(observer: ObserverBank, state: MonitorState, fit: HypothesisFit) -> MonitorState:
    """Run the observer again from the fit's onset with new sizes of the known faults."""
    window, before = state.window(fit.onset), state.believed
    moved = replace(state, believed=fit.value, detector_memory=None)
    return _run(observer, moved, window, before, fit.onset)


def drop_old_samples(state: MonitorState, fewest: int) -> MonitorState:
    """Remove the samples that no window can reach, except the last `fewest`.

    What is kept depends on the time only, so that no result depends on how many samples are processed at once.
    """
    first = max(min(int((state.samples.time < state.earliest_start).sum()) - 1, len(state.samples) - fewest), 0)
    return replace(
        state,
        samples=state.samples.segment(first, len(state.samples)),
        state=state.state[first:],
        residual=state.residual[first:],
        innovations=state.innovations[first:],
        white=state.white[first:],
        memory=state.memory[first:],
    )


def normalized_residuals(state: MonitorState, count: int, reach: int) -> Tensor:
    """The last white residuals (count, sensors) for the detector.

    While a fault is known, each is divided by the root mean square of the `reach` residuals before it, where that is
    above 1: the law of a real fault is inexact, and its error comes and goes with the levels.
    """
    white = state.white[-count:]
    if not bool(state.off_nominal.any()):
        return white
    before = state.white[:-1][-(count + reach - 1) :]
    missing = white.new_full((count + reach - 1 - len(before), white.shape[-1]), torch.nan)
    windows = torch.cat([missing, before]).unfold(0, reach, 1)
    # A cumulative sum adds in the same order however many samples are processed at once.
    total = windows.square().nan_to_num().cumsum(-1)[..., -1]
    return white / (total / torch.isfinite(windows).sum(-1).clamp(min=1)).sqrt().clamp(min=1.0)


def _run(
    observer: ObserverBank,
    state: MonitorState,
    window: ObserverWindow,
    before: Tensor,
    onset: float,
    incipient: bool = False,
) -> MonitorState:
    """Run the observer along a window at the end of the samples, and replace the stored results there.

    The parameters change from `before` to `state.believed` at `onset` s.
    """
    first = len(state.samples) - len(window)
    change = ChangeHypotheses(state.believed[None], before.new_tensor([onset]), torch.tensor([incipient]))
    path, residual = observer.run(window, before, change)
    innovations, memory = observer.whitening.innovations(residual, window.number, window.memory)
    moved = replace(
        state,
        state=torch.cat([state.state[:first], path[0]]),
        residual=torch.cat([state.residual[:first], residual[0]]),
        innovations=torch.cat([state.innovations[:first], innovations[0]]),
        memory=torch.cat([state.memory[:first], memory[0]]),
    )
    return _with_white_residuals(observer, moved, first)


def _with_white_residuals(observer: ObserverBank, state: MonitorState, first: int) -> MonitorState:
    """Whiten the residuals again from sample `first` on."""
    history = max(first - observer.whitening.order, 0)
    white = observer.whitening.of_innovations(state.innovations[history:])[first - history :]
    return replace(state, white=torch.cat([state.white[:first], white]))
