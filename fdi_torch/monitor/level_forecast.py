"""Forecast of overflow and dry tanks if the inputs keep their recent mean, by Monte Carlo simulation.

The draws are spread over the explanations in proportion to their probability, with sizes drawn from their standard
deviations, and start from the levels that each explanation implies. The inputs keep their recent average, faults that
grow continue to grow, and the random flows of the fault-free recording go on from their present estimate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from fdi_torch.monitor.events import Limit
from fdi_torch.monitor.flow_filter import FlowFilter
from fdi_torch.monitor.hypothesis import HypothesisFit
from fdi_torch.monitor.hypothesis_fit import changes_of
from fdi_torch.monitor.monitor_state import DetectedChange, MonitorState
from fdi_torch.monitor.observer_bank import ChangeHypotheses, ObserverBank
from fdi_torch.monitor.samples import Samples

DRAWS = 40
POINTS = 1000  # largest number of times at which levels are computed
EMPTY = 0.01  # share of a tank's height below which its outlet draws air
SMALLEST_CHANCE = 0.05  # less likely limits are not reported


@dataclass(frozen=True)
class _ContinuedRamps(ChangeHypotheses):
    """Changes with a duration of their own, (L,) s."""

    duration: Tensor

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
    now, order, tanks = state.now, observer.network.order, len(observer.network.description.tanks)
    latest = state.samples.time > now - recent
    inputs = state.samples.inputs[latest].mean(dim=0)
    flows = observer.whitening.flows
    points, span = _grid(horizon, horizon / POINTS if flows is None else flows.interval)
    time = now + torch.linspace(0.0, points * span, points + 1, dtype=torch.float64)
    chosen = _drawn_explanations(fits)
    before, changes = _drawn_parameters(observer, change, [fits[k] for k in chosen], now, horizon, generator)
    start, memory = _present_states(observer, state, change, fits)
    deviation, shocks = _random_flows(flows, memory[chosen], points, span, generator)
    start = start[chosen]
    start[:, :order] += deviation
    start[:, :tanks].clamp_(min=0.0)  # states of effects, such as flows, may be negative
    future = Samples(time, inputs.expand(points + 1, -1), state.samples.readings.new_full((points + 1, 1), torch.nan))
    levels = torch.cat([start.unsqueeze(1), observer.simulate(future, start, before, changes, shocks)], dim=1)
    limits = []
    for index, tank in enumerate(observer.network.description.tanks):
        path = levels[..., index]
        limits.append(limit_of(tank.name, "overflows", _crossing_time(path, tank.height, time - now)))
        limits.append(limit_of(tank.name, "runs dry", _crossing_time(-path, -EMPTY * tank.height, time - now)))
    likely = (f for f in limits if f.chance >= SMALLEST_CHANCE and f.time > 0.0)
    return tuple(sorted(likely, key=lambda limit: limit.time))


def _grid(horizon: float, interval: float) -> tuple[int, float]:
    """Number of points in a horizon, at most POINTS, and the time between them: whole intervals (s) of random flows."""
    span = max(math.ceil(horizon / (POINTS * interval) - 1e-9), 1) * interval
    return max(round(horizon / span), 1), span


def _drawn_explanations(fits: Sequence[HypothesisFit]) -> list[int]:
    """The explanation of each draw, in proportion to their probabilities."""
    probabilities = torch.tensor([f.probability for f in fits], dtype=torch.float64)
    edges = torch.cumsum(probabilities, 0) / probabilities.sum()
    quantiles = (torch.arange(DRAWS, dtype=torch.float64) + 0.5) / DRAWS
    chosen: list[int] = torch.searchsorted(edges, quantiles).clamp(max=len(fits) - 1).tolist()
    return chosen


def _present_states(
    observer: ObserverBank, state: MonitorState, change: DetectedChange, fits: Sequence[HypothesisFit]
) -> tuple[Tensor, Tensor]:
    """The observer's state (fits, order + M) and the flow filter's memory (fits, G) now, under each explanation."""
    window = state.window(min(f.onset for f in fits))
    path, residual = observer.run(window, change.before, changes_of(fits))
    memory = observer.whitening.innovations(residual, window.number, window.memory)[1]
    return path[:, -1], memory[:, -1]


def _drawn_parameters(
    observer: ObserverBank,
    change: DetectedChange,
    drawn: Sequence[HypothesisFit],
    now: float,
    horizon: float,
    generator: torch.Generator,
) -> tuple[Tensor, _ContinuedRamps]:
    """Parameters now (DRAWS, P), and their change over the horizon. drawn: the explanation of each draw."""
    space = observer.search_space(change.before)
    low, high = space.low(change.before), space.high(change.before)
    values, after = [], []
    for f in drawn:
        error = torch.randn(len(f.value), generator=generator, dtype=torch.float64)
        value = (f.value + torch.nan_to_num(f.std, posinf=0.0) * error).clamp(low, high)
        rate = (value - change.before) / (now - f.onset) if f.hypothesis.incipient else torch.zeros_like(value)
        values.append(value)
        after.append((value + rate * horizon).clamp(low, high))
    growing = torch.ones(DRAWS, dtype=torch.bool)
    onset, duration = (torch.full((DRAWS,), value, dtype=torch.float64) for value in (now, horizon))
    return torch.stack(values), _ContinuedRamps(torch.stack(after), onset, growing, duration)


def _random_flows(
    flows: FlowFilter | None, memory: Tensor, points: int, span: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Deviations (DRAWS, order) of the states from those of the observer now, and what random flows add to the states
    between the points (DRAWS, points, order), m.

    memory (DRAWS, G): of the flow filter, with one covariance for all. span: s between the points, a multiple of the
    filter's interval.
    """
    if flows is None:
        return memory.new_zeros(1, 1), memory.new_zeros(1, 1, 1)
    transition, covariance = flows.over(round(span / flows.interval))
    n, size = len(transition) // 2, len(transition)
    normal = torch.randn(points + 1, len(memory), 2 * n, generator=generator, dtype=memory.dtype)
    present = memory[:, :size] + normal[0] @ _root(flows.covariance_after(memory[0])[:size, :size]).mT
    deviation, flow = present.split(n, dim=1)
    level_shocks, flow_shocks = (normal[1:] @ _root(covariance).mT).split(n, dim=2)
    added = []
    for level_shock, flow_shock in zip(level_shocks, flow_shocks, strict=True):
        added.append(flow @ transition[:n, n:].mT + level_shock)
        flow = flow @ transition[n:, n:].mT + flow_shock
    return deviation, torch.stack(added, dim=1)


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


def limit_of(tank: str, what: Literal["overflows", "runs dry"], times: Tensor) -> Limit:
    """The forecast from times (DRAWS,) of equal probability, s; infinite where it does not happen."""
    ordered = times.sort().values
    low, middle, high = (_quantile(ordered, q) for q in (0.05, 0.5, 0.95))
    return Limit(tank, what, middle, low, high, float(torch.isfinite(times).double().mean()))


def _quantile(ordered: Tensor, q: float) -> float:
    """The value below which a further draw lies with probability q (Weibull's plotting positions)."""
    first = int(q * (len(ordered) + 1)) - 1
    below, above = ordered[first : first + 2].tolist()
    return below if below == above else below + (q * (len(ordered) + 1) - 1 - first) * (above - below)
