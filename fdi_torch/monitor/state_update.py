"""How a monitor's state moves on: new samples, new parameters of the observer, and forgetting of old samples."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from fdi_torch.monitor.hypothesis import HypothesisFit
from fdi_torch.monitor.monitor_state import DetectedChange, MonitorState
from fdi_torch.monitor.observer_bank import NEVER, ChangeHypotheses, ObserverBank, ObserverWindow
from fdi_torch.monitor.samples import ClockState, Samples, concatenated


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
