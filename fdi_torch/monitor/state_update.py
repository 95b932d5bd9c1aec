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
    white, effects = observer.whitening(residual[None]), len(observer.effects)
    zeros, now = torch.zeros_like(residual), float(first.time[0])
    return MonitorState(
        samples=first,
        state=state[None],
        residual=residual[None],
        white=white,
        fault_effects=zeros.expand(1, effects, -1),
        number=1,
        believed=believed,
        healthy=healthy,
        states_without=state.expand(effects, -1),
        reachable=now,
        unexplained_rms=zeros,
        clock=ClockState(now),
    )


def advance_observer(observer: ObserverBank, state: MonitorState, samples: Samples) -> MonitorState:
    """Run the observer along further samples."""
    last = len(state.samples) - 1
    window = ObserverWindow(concatenated(state.samples.segment(last, last + 1), samples), state.state[-1], state.number)
    state = replace(state, samples=concatenated(state.samples, samples), number=state.number + len(samples))
    return _run(observer, state, window, state.states_without, state.believed, NEVER)


def adopt_change(observer: ObserverBank, state: MonitorState, change: DetectedChange, believed: Tensor) -> MonitorState:
    """Run the observer again from the change's onset with new parameters (P,), and restart the detector."""
    fit = change.best
    window = state.window(fit.onset)
    incipient, active_before = fit.hypothesis.incipient, state.active_effects(observer)
    state = replace(state, believed=believed, change=change, pending=None, detector_memory=None)
    moved = _run(observer, state, window, _identical_starts(observer, window), change.before, fit.onset, incipient)
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
    return _run(observer, moved, window, _identical_starts(observer, window), before, fit.onset)


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
        white=state.white[first:],
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
    window: ObserverWindow,
    states_without: Tensor,
    before: Tensor,
    onset: float,
    incipient: bool = False,
) -> MonitorState:
    """Run the observer along a window at the end of the samples, and replace the stored results there.

    The parameters change from `before` to `state.believed` at `onset` s. states_without (E, tanks + M): states at the
    window's start of the parallel observers that each lack one effect; they give the effect of each known fault.
    """
    first, active = len(state.samples) - len(window), state.active_effects(observer)
    theta = torch.cat([state.believed[None], state.parameters_without_each(observer)])
    onsets = before.new_tensor([onset, *[LONG_AGO] * len(active)])
    changes = ChangeHypotheses(theta, onsets, torch.tensor([incipient, *[False] * len(active)]))
    starts = torch.cat([window.state[None], states_without[active]])
    path, residual = observer.run(replace(window, state=starts), before, changes)
    effects = residual.new_zeros(len(window), len(observer.effects), residual.shape[-1])
    effects[:, active] = (residual[1:] - residual[0]).movedim(0, 1).nan_to_num()
    last = path[0, -1].repeat(len(observer.effects), 1)
    last[active] = path[1:, -1]
    moved = replace(
        state,
        state=torch.cat([state.state[:first], path[0]]),
        residual=torch.cat([state.residual[:first], residual[0]]),
        fault_effects=torch.cat([state.fault_effects[:first], effects]),
        states_without=last,
    )
    return _with_white_residuals(observer, moved, first)


def _identical_starts(observer: ObserverBank, window: ObserverWindow) -> Tensor:
    """Start states (E, tanks + M) of the parallel observers, equal to that of the full observer."""
    return window.state.expand(len(observer.effects), -1)


def _with_white_residuals(observer: ObserverBank, state: MonitorState, first: int) -> MonitorState:
    """Whiten the residuals again from sample `first` on."""
    history = max(first - observer.whitening.order, 0)
    white = observer.whitening(state.residual[history:])[first - history :]
    return replace(state, white=torch.cat([state.white[:first], white]))
