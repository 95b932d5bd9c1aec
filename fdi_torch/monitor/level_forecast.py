"""Forecast of overflow and dry tanks if nothing changes, by Monte Carlo simulation from the monitor's present state.

The draws are spread over the explanations in proportion to their probability, with sizes drawn from their standard
deviations. The inputs keep their recent average, faults that grow continue to grow, and the random flows of the
fault-free recording go on from their present estimate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from fdi_torch.monitor.events import Limit
from fdi_torch.monitor.flow_filter import FlowFilter
from fdi_torch.monitor.hypothesis import HypothesisFit
from fdi_torch.monitor.monitor_state import DetectedChange, MonitorState
from fdi_torch.monitor.observer_bank import ChangeHypotheses, ObserverBank, ObserverWindow
from fdi_torch.monitor.samples import Samples

DRAWS = 40
POINTS = 200  # times at which levels are computed
EMPTY = 0.01  # share of a tank's height below which its outlet draws air
SMALLEST_CHANCE = 0.05  # less likely limits are not reported


@dataclass(frozen=True)
class _ContinuedRamps(ChangeHypotheses):
    """Changes with a duration of their own, (L,) s."""

    duration: Tensor

    def subset(self, first: int, last: int) -> _ContinuedRamps:
        rows = slice(first, last)
        return _ContinuedRamps(self.theta[rows], self.onset[rows], self.incipient[rows], self.duration[rows])

    def ramp(self, end: float) -> Tensor:
        return self.duration


def forecast_limits(
    observer: ObserverBank,
    state: MonitorState,
    change: DetectedChange,
    fits: Sequence[HypothesisFit],
    horizon: float,
    recent: float,
    generator: torch.Generator,
) -> tuple[Limit, ...]:
    """Each tank that may overflow or run dry within `horizon` s, soonest first.

    fits: the explanations with their probabilities. recent: s over which the inputs are averaged.
    """
    now, tanks = state.now, len(observer.network.description.tanks)
    latest = state.samples.time > now - recent
    inputs = state.samples.inputs[latest].mean(dim=0)
    time = now + torch.linspace(0.0, horizon, POINTS + 1, dtype=torch.float64)
    no_readings = torch.full((POINTS + 1, state.samples.readings.shape[-1]), torch.nan, dtype=torch.float64)
    future = Samples(time, inputs.expand(POINTS + 1, -1), no_readings)
    window = ObserverWindow(future, state.state[-1], state.number)
    before, changes = _drawn_parameters(observer, change, fits, now, horizon, generator)
    paths, start = observer.run(window, before, changes)[0][..., :tanks], state.state[-1, :tanks]
    levels = torch.cat([start.expand(DRAWS, 1, tanks), paths], dim=1)
    levels[:, 1:] += _random_flows(observer.whitening.flows, state, horizon / POINTS, generator)[..., :tanks]
    limits = []
    for index, tank in enumerate(observer.network.description.tanks):
        path = levels[..., index]
        limits.append(_limit(tank.name, "overflows", _crossing_time(path, tank.height, time - now)))
        limits.append(_limit(tank.name, "runs dry", _crossing_time(-path, -EMPTY * tank.height, time - now)))
    likely = (f for f in limits if f.chance >= SMALLEST_CHANCE and f.time > 0.0)
    return tuple(sorted(likely, key=lambda limit: limit.time))


def _drawn_parameters(
    observer: ObserverBank,
    change: DetectedChange,
    fits: Sequence[HypothesisFit],
    now: float,
    horizon: float,
    generator: torch.Generator,
) -> tuple[Tensor, _ContinuedRamps]:
    """Parameters now (DRAWS, P), and their change over the horizon."""
    probabilities = torch.tensor([f.probability for f in fits], dtype=torch.float64)
    edges = torch.cumsum(probabilities, 0) / probabilities.sum()
    quantiles = (torch.arange(DRAWS, dtype=torch.float64) + 0.5) / DRAWS
    chosen = torch.searchsorted(edges, quantiles).clamp(max=len(fits) - 1)
    low, high = observer.space.low(change.before), observer.space.high(change.before)
    values, after = [], []
    for k in chosen.tolist():
        f = fits[k]
        error = torch.randn(len(f.value), generator=generator, dtype=torch.float64)
        value = (f.value + torch.nan_to_num(f.std, posinf=0.0) * error).clamp(low, high)
        rate = (value - change.before) / max(now - f.onset, 1.0) if f.hypothesis.incipient else torch.zeros_like(value)
        values.append(value)
        after.append((value + rate * horizon).clamp(low, high))
    growing = torch.ones(DRAWS, dtype=torch.bool)
    onset, duration = (torch.full((DRAWS,), value, dtype=torch.float64) for value in (now, horizon))
    return torch.stack(values), _ContinuedRamps(torch.stack(after), onset, growing, duration)


def _random_flows(flows: FlowFilter | None, state: MonitorState, span: float, generator: torch.Generator) -> Tensor:
    """Deviations of the states by random flows (DRAWS, POINTS, order) m, from their present estimate and its error.

    span: s between the points.
    """
    if flows is None:
        return state.healthy.new_zeros(1, 1, 1)
    transition, shocks = flows.over(max(round(span / flows.interval), 1))
    root = _root(flows.covariance)
    now = state.memory[-1] + torch.randn(DRAWS, len(root), generator=generator, dtype=root.dtype) @ root.mT
    path, step = [], _root(shocks)
    for _ in range(POINTS):
        now = now @ transition.mT + torch.randn(DRAWS, len(root), generator=generator, dtype=root.dtype) @ step.mT
        path.append(now[:, : len(root) // 2])
    return torch.stack(path, dim=1)


def _root(covariance: Tensor) -> Tensor:
    """A matrix R with R R' = covariance, which may be singular."""
    values, vectors = torch.linalg.eigh(covariance)
    return vectors * values.clamp(min=0.0).sqrt()


def _crossing_time(path: Tensor, height: float, time: Tensor) -> Tensor:
    """When each path (L, K) first reaches a height, (L,) s; infinite if it does not."""
    above = path >= height
    first = above.to(torch.int8).argmax(dim=1)
    rows, previous = torch.arange(len(path)), (first - 1).clamp(min=0)
    rise = (path[rows, first] - path[rows, previous]).clamp(min=1e-12)
    share = ((height - path[rows, previous]) / rise).clamp(0.0, 1.0)
    crossing = time[previous] + share * (time[first] - time[previous])
    return torch.where(above.any(dim=1), torch.where(first == 0, 0.0, crossing), torch.inf)


def _limit(tank: str, what: Literal["overflows", "runs dry"], times: Tensor) -> Limit:
    ordered, count = times.sort().values, len(times)
    low, middle, high = (float(ordered[min(int(q * count), count - 1)]) for q in (0.05, 0.5, 0.95))
    return Limit(tank, what, middle, low, high, float(torch.isfinite(times).double().mean()))
