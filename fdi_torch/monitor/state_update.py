"""How a monitor's state moves on, along further samples and from the onset of a change with other parameters, and the
detector's test of its residuals.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from fdi_torch.estimate.evidence import ODDS
from fdi_torch.monitor.detection import Detector
from fdi_torch.monitor.hypothesis import HypothesisFit, faults_of
from fdi_torch.monitor.law_errors import SIZE_ERROR, STEP, LawErrors, normalized, prior_std
from fdi_torch.monitor.monitor_state import DetectedChange, MonitorState
from fdi_torch.monitor.observer_bank import LONG_AGO, ChangeHypotheses, ObserverBank, ObserverWindow
from fdi_torch.monitor.samples import ClockState, Samples, concatenated
from fdi_torch.monitor.sensor_outages import SensorOutages


def initial_state(
    observer: ObserverBank,
    samples: Samples,
    believed: Tensor,
    healthy: Tensor,
    *,
    levels: Tensor | None = None,
    correlation_time: float = 1.0,
) -> MonitorState:
    """The state after the first sample. levels (tanks,) m: taken from the readings if None. correlation_time: of the
    errors of known faults' laws, s.
    """
    first = samples.segment(0, 1)
    state, residual = observer.first_state(samples, believed, levels)
    innovations, memory = observer.whitening.innovations(residual[None])
    white, now = observer.whitening.of_innovations(innovations), float(first.time[0])
    known = _known_columns(observer, believed, healthy)
    return MonitorState(
        samples=first,
        state=state[None],
        residual=residual[None],
        innovations=innovations,
        white=white,
        tested=white,
        memory=memory,
        errors=LawErrors.at_start(
            known,
            correlation_time,
            state,
            memory[0],
            innovations[: observer.whitening.order],
            constants=observer.constants,
        ),
        number=1,
        believed=believed,
        healthy=healthy,
        reachable=now,
        clock=ClockState(now),
        outages=SensorOutages.at_start(observer.network.description.outputs()).along(first, now)[0],
    )


def _known_columns(observer: ObserverBank, believed: Tensor, healthy: Tensor) -> list[int]:
    """Columns of the sizes of the known faults."""
    return [f.size for f in faults_of(observer.space.names) if float(believed[f.size]) != float(healthy[f.size])]


def advance_observer(observer: ObserverBank, state: MonitorState, samples: Samples) -> MonitorState:
    """Run the observer along further samples."""
    last = len(state.samples) - 1
    further = concatenated(state.samples.segment(last, last + 1), samples)
    lanes = torch.cat([state.state[-1:], state.errors.state]), torch.cat([state.memory[-1:], state.errors.memory])
    window = ObserverWindow(further, lanes[0], state.number, lanes[1])
    state = replace(state, samples=concatenated(state.samples, samples), number=state.number + len(samples))
    return _run(observer, state, window, state.believed, LONG_AGO)


def adopt_change(observer: ObserverBank, state: MonitorState, change: DetectedChange, believed: Tensor) -> MonitorState:
    """Run the observer again from the change's onset with new parameters (P,), and restart the detector."""
    return adopt(observer, replace(state, change=change, pending=None), believed, change.before, change.best)


def beside_deviation(state: MonitorState) -> MonitorState:
    """Restart the detector after an alarm whose deviation no fault explains.

    From now on the residuals may contain a constant offset of unknown size at each sensor, which is estimated with the
    other errors. The deviation itself therefore raises no second alarm; a further change does.
    """
    return replace(state, detector_memory=None, errors=state.errors.with_unknown_deviation())


def adopt(
    observer: ObserverBank, state: MonitorState, believed: Tensor, before: Tensor, fit: HypothesisFit
) -> MonitorState:
    """Run the observer again from the onset of a change from `before` to `believed`, and restart the detector."""
    window = state.window(fit.onset)
    first, known = len(state.samples) - len(window), _known_columns(observer, believed, state.healthy)
    at_onset = window.state, state.memory[first - 1], _innovations_before(observer, state, first)
    sizes, before_onset = _size_errors(state, believed, known, fit), state.errors
    errors = LawErrors.at_start(known, before_onset.correlation_time, *at_onset, sizes, before_onset.constants)
    state = replace(state, believed=believed, errors=errors, detector_memory=None)
    return _run(observer, state, window, before, fit.onset, fit.hypothesis.incipient)


def _size_errors(state: MonitorState, believed: Tensor, known: Sequence[int], fit: HypothesisFit) -> list[float]:
    """Relative standard deviation of the size of each known fault before the readings since a change.

    The readings since the change determine the sizes that it changes. The others are as well known as before it, but no
    better than their laws: if a pump rests meanwhile, the end of its fault is no error of the fault's size.
    """
    estimated = {t.column: t.last[2] for t in state.tracks if t.column not in fit.hypothesis.columns}
    effect = (believed - state.healthy).abs()
    relative = (estimated[c] / float(effect[c]) if c in estimated else math.inf for c in known)
    return [min(math.hypot(error, ODDS.law_error), SIZE_ERROR) for error in relative]


def _innovations_before(observer: ObserverBank, state: MonitorState, first: int) -> Tensor:
    """The innovations on which the white residual of sample `first` depends."""
    return state.innovations[max(first - observer.whitening.order, 0) : first]


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
        tested=state.tested[first:],
        memory=state.memory[first:],
    )


def _run(
    observer: ObserverBank,
    state: MonitorState,
    window: ObserverWindow,
    before: Tensor,
    onset: float,
    incipient: bool = False,
) -> MonitorState:
    """Run the observer along a window at the end of the samples, and replace the stored results there.

    The observer uses the parameters `before` until `onset` s and `state.believed` from then on. The window's state,
    its memory and the errors of the known faults are those at its beginning.
    """
    first, errors, order = len(state.samples) - len(window), state.errors, observer.whitening.order
    raised = torch.where(state.off_nominal, state.believed - state.healthy, prior_std(observer.space))
    columns = [*errors.columns, *errors.constants.columns]
    theta = state.believed.repeat(1 + len(columns), 1)
    theta[1:] += STEP * torch.diag(raised)[columns]
    change = ChangeHypotheses(theta, theta.new_full((len(theta),), onset), torch.full((len(theta),), incipient))
    path, residual = observer.run(window, before, change)
    innovations, memory = observer.whitening.innovations(residual, window.number, window.memory)
    past = torch.cat([_innovations_before(observer, state, first)[None], errors.innovations])
    history = torch.cat([past, innovations], dim=1)
    white = observer.whitening.of_innovations(history)[:, past.shape[1] :]
    errors, tested = errors.after(white[0], (white[1:] - white[0]) / STEP, torch.diff(window.samples.time))
    latest = history[1:, max(history.shape[1] - order, 0) :]
    return replace(
        state,
        state=torch.cat([state.state[:first], path[0]]),
        residual=torch.cat([state.residual[:first], residual[0]]),
        innovations=torch.cat([state.innovations[:first], innovations[0]]),
        white=torch.cat([state.white[:first], white[0]]),
        tested=torch.cat([state.tested[:first], tested]),
        memory=torch.cat([state.memory[:first], memory[0]]),
        errors=replace(errors, state=path[1:, -1], memory=memory[1:, -1], innovations=latest),
    )


class ResidualTest:
    """The detector on the residuals of a state. reach: samples over which those beside known faults are normalized."""

    def __init__(self, detector: Detector, lookback: float) -> None:
        self.detector, self.reach = detector, max(round(lookback / detector.design.interval), 1)

    def statistic(self, state: MonitorState, count: int, memory: Tensor | None) -> tuple[Tensor, Tensor]:
        """The detector's statistic at the last `count` samples, (count,), and its memory after them. memory: before."""
        return self.detector.update(residuals_to_test(state, count, self.reach), memory)

    def is_quiet(self, state: MonitorState) -> bool:
        """Whether the detector, run again from the latest change on, stays within its threshold now.

        The misfit of a long window is no such test: its noise hides a deviation of a few seconds.
        """
        statistic, _ = self.statistic(state, _samples_after(state, state.valid_since), None)
        return float(statistic[-1]) <= self.detector.threshold

    def shares(self, state: MonitorState, since: float) -> list[float]:
        """The share of each sensor in the detector's statistic, by the samples after `since`, s."""
        white = residuals_to_test(state, _samples_after(state, since), self.reach)
        shares: list[float] = self.detector.shares(white).tolist()
        return shares


def residuals_to_test(state: MonitorState, count: int, reach: int) -> Tensor:
    """The last white residuals (count, sensors); those beside known faults are normalized over `reach` samples."""
    return normalized(state.tested, count, reach) if bool(state.off_nominal.any()) else state.tested[-count:]


def _samples_after(state: MonitorState, time: float) -> int:
    return max(int((state.samples.time > time).sum()), 1)
