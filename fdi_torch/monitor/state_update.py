"""How a monitor's state moves on: new samples, new parameters of the observer, and forgetting of old samples."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from fdi_torch.monitor.hypothesis import HypothesisFit
from fdi_torch.monitor.monitor_state import DetectedChange, MonitorState
from fdi_torch.monitor.observer_bank import LONG_AGO, NEVER, ChangeHypotheses, ObserverBank, ObserverWindow
from fdi_torch.monitor.samples import ClockState, Samples, concatenated

# Assumed error of a fault's model, as a share of the fault's effect: a real leak is not an ideal orifice.
FAULT_MODEL_ERROR = 0.1


def initial_state(
    observer: ObserverBank, samples: Samples, believed: Tensor, healthy: Tensor, levels: Tensor | None = None
) -> MonitorState:
    """The state after the first sample. levels (tanks,) m: taken from the readings if None."""
    first = samples.segment(0, 1)
    state, residual = observer.first_state(samples, believed, levels)
    innovations, memory = observer.whitening.innovations(residual[None])
    white, effects = observer.whitening.of_innovations(innovations), len(observer.effects)
    zeros, now = torch.zeros_like(residual), float(first.time[0])
    return MonitorState(
        samples=first,
        state=state[None],
        residual=residual[None],
        innovations=innovations,
        white=white,
        memory=memory,
        fault_effects=zeros.expand(1, effects, -1),
        number=1,
        believed=believed,
        healthy=healthy,
        states_without=state.expand(effects, -1),
        memory_without=memory.expand(effects, -1),
        reachable=now,
        unexplained_rms=zeros,
        clock=ClockState(now),
    )


def advance_observer(observer: ObserverBank, state: MonitorState, samples: Samples) -> MonitorState:
    """Run the observer along further samples."""
    last = len(state.samples) - 1
    further = concatenated(state.samples.segment(last, last + 1), samples)
    starts = ObserverWindow(
        further,
        torch.cat([state.state[-1:], state.states_without]),
        state.number,
        torch.cat([state.memory[-1:], state.memory_without]),
    )
    state = replace(state, samples=concatenated(state.samples, samples), number=state.number + len(samples))
    return _run(observer, state, starts, state.believed, NEVER)


def adopt_change(observer: ObserverBank, state: MonitorState, change: DetectedChange, believed: Tensor) -> MonitorState:
    """Run the observer again from the change's onset with new parameters (P,), and restart the detector."""
    fit = change.best
    window = state.window(fit.onset)
    incipient, active_before = fit.hypothesis.incipient, state.active_effects(observer)
    state = replace(state, believed=believed, change=change, pending=None, detector_memory=None)
    moved = _run(observer, state, _identical_starts(observer, window), change.before, fit.onset, incipient)
    rms = moved.white[-len(window) :].square().nanmean(dim=0).nan_to_num().sqrt()
    if fit.fits or not moved.active_effects(observer):
        rms = torch.zeros_like(rms)
    elif set(state.active_effects(observer)) >= set(active_before):
        rms = torch.maximum(rms, state.unexplained_rms)  # no fault recovered: the earlier misfit may come back
    return replace(moved, unexplained_rms=rms)


def adopt_sizes(observer: ObserverBank, state: MonitorState, fit: HypothesisFit) -> MonitorState:
    """Run the observer again from the fit's onset with new sizes of the known faults."""
    window, before = state.window(fit.onset), state.believed
    moved = replace(state, believed=fit.value, detector_memory=None)
    return _run(observer, moved, _identical_starts(observer, window), before, fit.onset)


def drop_old_samples(state: MonitorState) -> MonitorState:
    """Remove the samples that no window can reach, once they are a quarter of all."""
    first = max(int((state.samples.time < state.earliest_start).sum()) - 1, 0)
    if first < 0.25 * len(state.samples):
        return state
    return replace(
        state,
        samples=state.samples.segment(first, len(state.samples)),
        state=state.state[first:],
        residual=state.residual[first:],
        innovations=state.innovations[first:],
        white=state.white[first:],
        memory=state.memory[first:],
        fault_effects=state.fault_effects[first:],
    )


def normalized_residuals(observer: ObserverBank, state: MonitorState, count: int) -> Tensor:
    """The last white residuals (count, sensors) for the detector, widened for the model error of the known faults.

    e / sqrt(max(1, r)^2 + sum_i (c f_i)^2): e the white residual, f_i what known fault i takes out of it at that
    moment, c = FAULT_MODEL_ERROR, r the root mean square that the faults left unexplained when they were fitted.
    """
    active = state.active_effects(observer)
    if not active:
        return state.white[-count:]
    history = count + observer.whitening.order
    effects = observer.whitening.filter(state.fault_effects[-history:, active].movedim(1, 0))[:, -count:]
    variance = state.unexplained_rms.clamp(min=1.0) ** 2 + (FAULT_MODEL_ERROR * effects).square().sum(0)
    return state.white[-count:] / torch.sqrt(variance)


def fault_effect_rms(observer: ObserverBank, state: MonitorState, column: int, since: float) -> float:
    """Root mean square of what a known fault adds to the white residuals since a time (s)."""
    [effect] = [e for e, columns in enumerate(observer.effects) if column in columns]
    count = max(int((state.samples.time > since).sum()), 1)
    return float(observer.whitening.filter(state.fault_effects[:, effect])[-count:].square().mean().sqrt())


def _run(
    observer: ObserverBank,
    state: MonitorState,
    starts: ObserverWindow,
    before: Tensor,
    onset: float,
    incipient: bool = False,
) -> MonitorState:
    """Run the observer along a window at the end of the samples, and replace the stored results there.

    The parameters change from `before` to `state.believed` at `onset` s. starts: the window, with the state of the
    observer in the first row (1 + E, order + M), and below it those of the parallel observers that each lack one
    effect; these give the effect of each known fault. Its memory likewise.
    """
    first, active = len(state.samples) - len(starts), state.active_effects(observer)
    theta = torch.cat([state.believed[None], state.parameters_without_each(observer)])
    onsets = before.new_tensor([onset, *[LONG_AGO] * len(active)])
    changes = ChangeHypotheses(theta, onsets, torch.tensor([incipient, *[False] * len(active)]))
    assert starts.memory is not None
    rows, effect_count = [0, *(1 + e for e in active)], len(observer.effects)
    lanes = replace(starts, state=starts.state[rows], memory=starts.memory[rows])
    path, residual = observer.run(lanes, before, changes)
    innovations, memory = observer.whitening.innovations(residual, starts.number, lanes.memory)
    effects = residual.new_zeros(len(starts), effect_count, residual.shape[-1])
    effects[:, active] = (innovations[1:] - innovations[0]).movedim(0, 1).nan_to_num()
    states_without, memory_without = (x[0, -1].repeat(effect_count, 1) for x in (path, memory))
    states_without[active], memory_without[active] = path[1:, -1], memory[1:, -1]
    moved = replace(
        state,
        state=torch.cat([state.state[:first], path[0]]),
        residual=torch.cat([state.residual[:first], residual[0]]),
        innovations=torch.cat([state.innovations[:first], innovations[0]]),
        memory=torch.cat([state.memory[:first], memory[0]]),
        fault_effects=torch.cat([state.fault_effects[:first], effects]),
        states_without=states_without,
        memory_without=memory_without,
    )
    return _with_white_residuals(observer, moved, first)


def _identical_starts(observer: ObserverBank, window: ObserverWindow) -> ObserverWindow:
    """The window with the same start states for the full observer and for the parallel ones, (1 + E, ...) each."""
    assert window.memory is not None
    rows = 1 + len(observer.effects)
    return replace(window, state=window.state.expand(rows, -1), memory=window.memory.expand(rows, -1))


def _with_white_residuals(observer: ObserverBank, state: MonitorState, first: int) -> MonitorState:
    """Whiten the residuals again from sample `first` on."""
    history = max(first - observer.whitening.order, 0)
    white = observer.whitening.of_innovations(state.innovations[history:])[first - history :]
    return replace(state, white=torch.cat([state.white[:first], white]))
