"""The monitor: observer, alarm, isolation and sizes along a recording, each change fed back into the observer.

The 2020 paper's adaptive observer (16): the newest parameters go back into the observer. Here they are found from the
white innovations, together with the moment of change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.monitor.change import ChangedObserver, Changes
from fdi_torch.monitor.detection import NEVER, Detector
from fdi_torch.monitor.events import Event, Kind
from fdi_torch.monitor.isolation import Finding, isolate, refit
from fdi_torch.monitor.noise import Noise
from fdi_torch.monitor.observer import Observer, first_levels
from fdi_torch.monitor.samples import Samples
from fdi_torch.monitor.stepper import LONGEST_STEP, PlantState
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork

GAP = 10.0  # sampling intervals without a sample before the observer starts afresh
RIVAL = 6.0  # difference in BIC below which another explanation stands beside the best


# Samples between two looks of the detector, so that a long recording given at once is followed as it would have come.
MOST_AT_ONCE = 16


@dataclass(frozen=True)
class MonitorSettings:
    """In seconds. lookback: how far before an alarm a change is sought. confirm: how long after an alarm the faults are
    told apart. revise: factor by which the time since the onset grows before sizes are estimated again. longest: a
    window never reaches further back. incipient: whether faults may also grow slowly. together: how many at once.
    """

    lookback: float = 300.0
    confirm: float = 60.0
    revise: float = 2.0
    longest: float = 1000.0
    incipient: bool = True
    together: int = 2

    def __post_init__(self) -> None:
        if not (self.lookback > 0 and self.confirm >= 0 and self.revise > 1 and self.longest >= self.lookback):
            raise ValueError(
                "expected lookback > 0, confirm >= 0, revise > 1 and longest >= lookback, "
                f"got {self.lookback:g} s, {self.confirm:g} s, {self.revise:g}, {self.longest:g} s; change them"
            )


@dataclass(frozen=True)
class Change:
    """A change that was found: the belief before it, the finding, when the alarm came and when to look again."""

    before: Tensor
    finding: Finding
    alarm: float
    next_look: float


@dataclass(frozen=True)
class MonitorState:
    """All that a monitor carries from sample to sample.

    samples, levels (S, tanks): what was seen lately and the observer's levels after each. white (S', sensors): since
    the detector's last start. number: samples since the observer's start. believed (P,). alarm: one that is being
    looked into, s. change: the latest. reachable: no window starts before it, s.
    """

    samples: Samples
    levels: Tensor
    residual: Tensor
    watched: int
    number: int
    believed: Tensor
    reachable: float
    alarm: float | None = None
    change: Change | None = None


class Monitor:
    """Follows one plant. The first `watched` parameters of `space` (all by default) may change, the others are only
    believed. State in, state out: `advance`.
    """

    def __init__(
        self,
        network: TankNetwork,
        space: ParameterSpace,
        noise: Noise,
        detector: Detector,
        settings: MonitorSettings | None = None,
        longest_step: float = LONGEST_STEP,
        watched: int | None = None,
    ) -> None:
        if not len(space):
            raise ValueError("expected at least one fault to watch for, got none; name some")
        self.network, self.space, self.noise, self.detector = network, space, noise, detector
        self.settings, self.longest_step = settings or MonitorSettings(), longest_step
        self.watched = len(space) if watched is None else watched
        self._latest: tuple[Tensor, Observer] | None = None
        self._changed = ChangedObserver(network, space, noise.gain, noise.whitening, longest_step)

    def start(self, samples: Samples, believed: Tensor | None = None, levels: Tensor | None = None) -> MonitorState:
        """The state after the first of some samples."""
        theta = self.space.nominal() if believed is None else believed
        return self._afresh(samples.stretch(0, 1), theta, levels)

    def advance(self, state: MonitorState, samples: Samples) -> tuple[MonitorState, list[Event]]:
        """Takes the samples that have come since, in order; their clock may jump and readings or inputs may lack."""
        events: list[Event] = []
        for stretch, notice in continuous(state.samples, samples):
            if notice:
                events.append(Event(float(stretch.time[0]), "notice", notice))
                state = self._afresh(stretch.stretch(0, 1), state.believed, None)
                stretch = stretch.stretch(1, len(stretch))
            while len(stretch):
                state, taken, news = self._take(state, stretch)
                events += news
                stretch = stretch.stretch(taken, len(stretch))
        return state, events

    def _take(self, state: MonitorState, samples: Samples) -> tuple[MonitorState, int, list[Event]]:
        """As many samples as can be taken before something is to be done, and what then comes of it."""
        until = self._next_look(state)
        due = samples.time >= until
        count = int(due.to(torch.int8).argmax()) + 1 if bool(due.any()) else len(samples)
        count = min(count, MOST_AT_ONCE)
        state = self._observe(state, samples.stretch(0, count))
        if state.alarm is None:
            white = self.noise.whitening(state.residual)[state.watched :]
            first = int(self.detector.first_alarm(white))
            if first != NEVER:
                state, events = self._alarm(state, float(state.samples.time[state.watched + first]))
                return state, count, events
        if float(state.samples.time[-1]) >= self._next_look(state):
            state, events = self._look(state)
            return state, count, events
        return state, count, []

    def _alarm(self, state: MonitorState, time: float) -> tuple[MonitorState, list[Event]]:
        """An alarm; or only better sizes, where those of the last change explain the residual."""
        now = float(state.samples.time[-1])
        if state.change is not None and self._within_window(state, state.change, now):
            revised, events = self._revise(state, state.change, now, "revised", (state.change.finding,))
            assert revised.change is not None
            if _fits(revised.change.finding):
                return revised, events
        return replace(state, alarm=time), [Event(time, "alarm", "the residual leaves its fault-free range")]

    def _next_look(self, state: MonitorState) -> float:
        if state.alarm is not None:
            return state.alarm + self.settings.confirm
        return state.change.next_look if state.change is not None else float("inf")

    def _observe(self, state: MonitorState, samples: Samples) -> MonitorState:
        """The observer moved on; of the past only what a window may need is kept."""
        joined = _joined(state.samples.stretch(len(state.samples) - 1, len(state.samples)), samples)
        plant = PlantState(state.levels[-1])
        observer = self._observer(state.believed)
        seen = observer.resume(joined, plant, state.number)
        state = replace(
            state,
            samples=_joined(state.samples, samples),
            levels=torch.cat([state.levels, seen.levels]),
            residual=torch.cat([state.residual, seen.steady_residual]),
            number=state.number + len(samples),
        )
        return self._forget(state)

    def _forget(self, state: MonitorState) -> MonitorState:
        keep_from = float(state.samples.time[-1]) - self.settings.longest - self.settings.lookback
        if state.alarm is not None:
            keep_from = min(keep_from, state.alarm - self.settings.lookback)
        first = min(int((state.samples.time < keep_from).sum()), state.watched)
        if first < 0.25 * len(state.samples):
            return state
        return replace(
            state,
            samples=state.samples.stretch(first, len(state.samples)),
            levels=state.levels[first:],
            residual=state.residual[first:],
            watched=max(state.watched - first, 0),
        )

    def _look(self, state: MonitorState) -> tuple[MonitorState, list[Event]]:
        """Tells faults apart after an alarm, or estimates their sizes again."""
        now = float(state.samples.time[-1])
        change = state.change
        if state.alarm is None:
            assert change is not None
            return self._revise(state, change, now, "revised")
        if change is not None and self._within_window(state, change, now):
            # Was the last change only taken for the wrong one? One change explaining all is preferred to two.
            revised, events = self._revise(state, change, now, "isolated")
            assert revised.change is not None
            if _fits(revised.change.finding):
                return revised, events
        return self._isolate(state, now)

    def _isolate(self, state: MonitorState, now: float) -> tuple[MonitorState, list[Event]]:
        assert state.alarm is not None
        start = max(state.alarm - self.settings.lookback, state.reachable)
        finding, rivals = self._best(state, start, state.believed)
        if finding.score >= 0.0:
            text = "no fault of the list explains the alarm better than noise does"
            event = Event(now, "unexplained", text)
            return replace(state, alarm=None, watched=len(state.samples)), [event]
        change = Change(state.believed, finding, state.alarm, self._look_again(finding, now))
        events = self._tell(change, rivals, now, "isolated")
        return self._believe(state, change), events

    def _revise(
        self, state: MonitorState, change: Change, now: float, kind: Kind, only: tuple[Finding, ...] = ()
    ) -> tuple[MonitorState, list[Event]]:
        """The last change estimated again from all that has come since; `only`: of the same kind as before."""
        start = max(change.finding.onset - self.settings.lookback, float(state.samples.time[0]))
        before = replace(state, believed=change.before)
        if not self._within_window(state, change, now):
            return replace(state, change=replace(change, next_look=float("inf"))), []
        finding, rivals = self._best(before, max(start, state.reachable), change.before, only)
        alarm = change.alarm if state.alarm is None or change.alarm > finding.onset - 1.0 else state.alarm
        revised = replace(change, finding=finding, alarm=alarm, next_look=self._look_again(finding, now))
        events = self._tell(revised, rivals, now, kind)
        return self._believe(before, revised), events

    def _within_window(self, state: MonitorState, change: Change, now: float) -> bool:
        return now - change.finding.onset <= self.settings.longest and change.finding.onset >= state.reachable

    def _look_again(self, finding: Finding, now: float) -> float:
        since = max(now - finding.onset, self.settings.confirm, 1.0)
        return finding.onset + self.settings.revise * since

    def _best(
        self, state: MonitorState, start: float, believed: Tensor, only: tuple[Finding, ...] = ()
    ) -> tuple[Finding, tuple[str, ...]]:
        first = min(int((state.samples.time < start).sum()), max(len(state.samples) - 3, 0))
        window = state.samples.stretch(first + 1, len(state.samples))
        predicted = self._predicted(state, first, believed)
        if only:
            return refit(self._changed, window, predicted, believed, only)[0], ()
        columns = list(range(self.watched))
        found = isolate(
            self._changed, window, predicted, believed, columns, self.settings.incipient, self.settings.together
        )
        best = found[0]
        near = [f for f in found[1:] if f.score - best.score < RIVAL]
        rivals = [f for f in near if not set(best.hypothesis.columns) <= set(f.hypothesis.columns)]
        return best, tuple(dict.fromkeys(" + ".join(self._names(f)) for f in rivals))

    def _predicted(self, state: MonitorState, first: int, believed: Tensor) -> Tensor:
        """Levels before the correction at the sample after `first`."""
        times = state.samples.time.tolist()
        observer = self._observer(believed)
        plant = observer.stepper.advance(
            PlantState(state.levels[first]),
            lambda share: state.samples.input_at(first, share),
            times[first],
            times[first + 1] - times[first],
            observer.values,
        )
        return plant.levels

    def _believe(self, state: MonitorState, change: Change) -> MonitorState:
        """Feeds the newest parameters back: the observer runs again from the onset, the detector starts afresh."""
        finding = change.finding
        believed = finding.value.clone()
        for c in finding.hypothesis.columns:
            if self._is_nominal(finding, c):
                believed[c] = self.space.parameters[c].nominal
        first = max(min(int((state.samples.time < finding.onset).sum()), len(state.samples) - 2) - 1, 0)
        window = state.samples.stretch(first + 1, len(state.samples))
        predicted = self._predicted(state, first, change.before)
        came = Changes(believed[None], torch.tensor([finding.onset]), torch.tensor([finding.hypothesis.incipient]))
        levels, residual = self._changed.follow(window, predicted, change.before, came)
        return replace(
            state,
            believed=believed,
            levels=torch.cat([state.levels[: first + 1], levels[0]]),
            residual=torch.cat([state.residual[: first + 1], residual[0]]),
            watched=len(state.samples),
            alarm=None,
            change=change,
        )

    def _is_nominal(self, finding: Finding, column: int) -> bool:
        nominal = self.space.parameters[column].nominal
        return abs(float(finding.value[column]) - nominal) <= 3.0 * float(finding.std[column])

    def _tell(self, change: Change, rivals: tuple[str, ...], now: float, kind: Kind) -> list[Event]:
        finding, names = change.finding, self._names(change.finding)
        columns = finding.hypothesis.columns
        back = [c for c in columns if self._is_nominal(finding, c) and not self._was_nominal(change, c)]
        sizes = tuple(float(finding.value[c]) for c in columns)
        stds = tuple(float(finding.std[c]) for c in columns)
        units = tuple(self.space.parameters[c].unit for c in columns)
        parts = [_amount(*row) for row in zip(names, sizes, stds, units, strict=True)]
        manner = "growing since" if finding.hypothesis.incipient else "since"
        text = f"{', '.join(parts)}, {manner} {finding.onset:.1f} ± {finding.onset_std:.2g} s"
        if rivals:
            text += f"; or {' or '.join(rivals)}"
        if not _fits(finding):
            text += "; does not explain all of the residual"
        told: Kind = "recovered" if len(back) == len(columns) else kind
        onset, incipient = finding.onset, finding.hypothesis.incipient
        delay = change.alarm - onset
        return [Event(now, told, text, names, sizes, stds, units, onset, finding.onset_std, incipient, delay, rivals)]

    def _was_nominal(self, change: Change, column: int) -> bool:
        return float(change.before[column]) == self.space.parameters[column].nominal

    def _names(self, finding: Finding) -> tuple[str, ...]:
        return tuple(self.space.names[c] for c in finding.hypothesis.columns)

    def _observer(self, believed: Tensor) -> Observer:
        """The same one as long as the belief is the same, since its recorded step is worth keeping."""
        if self._latest is None or not torch.equal(self._latest[0], believed):
            fresh = Observer(self.network, self.noise.gain, self.space, believed, self.longest_step)
            self._latest = (believed, fresh)
        return self._latest[1]

    def _afresh(self, first: Samples, believed: Tensor, levels: Tensor | None) -> MonitorState:
        """The observer from one sample on, its levels from the readings."""
        observer = self._observer(believed)
        if levels is None:
            levels = first_levels(self.network, first, observer.values)
        plant = observer.stepper.start(levels, first.input_at(0), observer.values)
        plant, residual = observer.correct(plant, first.readings[0], 0, float(first.time[0]), 1.0)
        scaled = residual / self.noise.gain.inflation_at(0)
        return MonitorState(first, plant.levels[None], scaled[None], 0, 1, believed, float(first.time[0]))


def continuous(before: Samples, samples: Samples) -> list[tuple[Samples, str]]:
    """The new samples in stretches without a gap, a jump of the clock or unknown inputs, each with a sentence on what
    lies before it, empty where nothing does. A sample that repeats the last one's time is left out.
    """
    known = torch.isfinite(samples.inputs).all(dim=-1)
    steps = torch.diff(torch.cat([before.time, samples.time]))
    usual = float(steps[steps > 0].median()) if bool((steps > 0).any()) else 1.0
    last = float(before.time[-1])
    stretches: list[tuple[list[int], str]] = [([], "")]
    unknown_since: float | None = None
    for k, time in enumerate(samples.time.tolist()):
        if time == last:
            continue
        if not bool(known[k]):
            unknown_since = time if unknown_since is None else unknown_since
            last = time
            continue
        notice = _notice(last, time, usual, unknown_since)
        if notice:
            stretches.append(([], notice))
        stretches[-1][0].append(k)
        last, unknown_since = time, None
    return [(_chosen(samples, kept), notice) for kept, notice in stretches if kept]


def _notice(last: float, time: float, usual: float, unknown_since: float | None) -> str:
    if time < last:
        return f"the clock jumps back by {last - time:g} s; the observer starts afresh on the new time"
    if unknown_since is not None:
        return f"an input is unknown from {unknown_since:g} s to {time:g} s; the observer starts afresh"
    if time - last > GAP * usual:
        return f"no samples for {time - last:g} s; the observer starts afresh"
    return ""


def _amount(name: str, size: float, std: float, unit: str) -> str:
    return f"{name} = {size:.4g} ± {std:.2g}" + ("" if unit == "1" else f" {unit}")


def _fits(finding: Finding) -> bool:
    """Whether the white innovations are no larger than noise, to four standard deviations of their sum of squares."""
    return 2.0 * finding.misfit <= finding.readings + 4.0 * (2.0 * finding.readings) ** 0.5


def _chosen(samples: Samples, rows: Sequence[int]) -> Samples:
    index = torch.tensor(list(rows))
    return Samples(samples.time[index], samples.inputs[index], samples.readings[index], samples.hold)


def _joined(first: Samples, second: Samples) -> Samples:
    return Samples(
        torch.cat([first.time, second.time]),
        torch.cat([first.inputs, second.inputs]),
        torch.cat([first.readings, second.readings]),
        second.hold,
    )
