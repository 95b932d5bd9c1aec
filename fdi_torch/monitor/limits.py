"""When a tank overflows or runs dry if nothing changes: the plant run ahead from what is believed.

Each explanation is drawn as often as its share of the posterior says, with sizes drawn from their standard errors; the
inputs stay what they were on average, faults that grow go on growing, and levels wander as they did without a fault.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from fdi_torch.monitor.change import NEVER, ChangedObserver, Changes, Window
from fdi_torch.monitor.events import Limit
from fdi_torch.monitor.following import Change, MonitorState
from fdi_torch.monitor.hypothesis import Finding
from fdi_torch.monitor.noise import Noise
from fdi_torch.monitor.observer import MOVED
from fdi_torch.monitor.samples import Samples
from fdi_torch.plant.scales import length_scale

DRAWS = 40
POINTS = 200  # instants at which levels are looked at
EMPTY = 0.01  # of a tank's height: below it an outlet draws air
LIKELY = 0.05  # limits with a smaller chance are not told


@dataclass(frozen=True)
class _Lasting(Changes):
    """Changes that take `lasts` (L,) s each."""

    lasts: Tensor

    def part(self, first: int, last: int) -> _Lasting:
        own = slice(first, last)
        return _Lasting(self.theta[own], self.onset[own], self.incipient[own], self.lasts[own])

    def ramp(self, end: float) -> Tensor:
        return self.lasts


def limits(
    observer: ChangedObserver,
    noise: Noise,
    state: MonitorState,
    change: Change,
    told: Sequence[Finding],
    horizon: float,
    recent: float,
    generator: torch.Generator,
) -> tuple[Limit, ...]:
    """Each tank that may overflow or run dry within `horizon` s. told: explanations with their masses. recent: s over
    which the inputs are averaged.
    """
    now, tanks = state.now, len(observer.network.description.tanks)
    lately = state.samples.time > now - recent
    inputs = state.samples.inputs[lately].mean(dim=0)
    time = now + torch.linspace(0.0, horizon, POINTS + 1, dtype=torch.float64)
    blank = torch.full((POINTS + 1, state.samples.readings.shape[-1]), torch.nan, dtype=torch.float64)
    ahead = Samples(time, inputs.expand(POINTS + 1, -1), blank)
    window = Window(ahead, state.state[-1], state.number)
    before, changes = _drawn(observer, change, told, now, horizon, generator)
    paths, start = observer.follow(window, before, changes)[0][..., :tanks], state.state[-1, :tanks]
    levels = torch.cat([start.expand(DRAWS, 1, tanks), paths], dim=1)
    levels[:, 1:] += _wander(observer, noise, window, state.believed, generator)
    found = []
    for index, tank in enumerate(observer.network.description.tanks):
        path = levels[..., index]
        found.append(_limit(tank.name, "overflows", _crossed(path, tank.height, time - now)))
        found.append(_limit(tank.name, "runs dry", _crossed(-path, -EMPTY * tank.height, time - now)))
    return tuple(sorted((f for f in found if f.chance >= LIKELY and f.time > 0.0), key=lambda limit: limit.time))


def _drawn(
    observer: ChangedObserver,
    change: Change,
    told: Sequence[Finding],
    now: float,
    horizon: float,
    generator: torch.Generator,
) -> tuple[Tensor, _Lasting]:
    """Values now (DRAWS, P), and how they go on."""
    masses = torch.tensor([f.mass for f in told], dtype=torch.float64)
    edges = torch.cumsum(masses, 0) / masses.sum()
    which = torch.searchsorted(edges, (torch.arange(DRAWS, dtype=torch.float64) + 0.5) / DRAWS).clamp(max=len(told) - 1)
    low, high = observer.space.low(change.before), observer.space.high(change.before)
    values, after = [], []
    for k in which.tolist():
        f = told[k]
        error = torch.randn(len(f.value), generator=generator, dtype=torch.float64)
        value = (f.value + torch.nan_to_num(f.std, posinf=0.0) * error).clamp(low, high)
        rate = (value - change.before) / max(now - f.onset, 1.0) if f.hypothesis.incipient else torch.zeros_like(value)
        values.append(value)
        after.append((value + rate * horizon).clamp(low, high))
    late = torch.ones(DRAWS, dtype=torch.bool)
    onset, lasts = torch.full((DRAWS,), now, dtype=torch.float64), torch.full((DRAWS,), horizon, dtype=torch.float64)
    return torch.stack(values), _Lasting(torch.stack(after), onset, late, lasts)


def _wander(
    observer: ChangedObserver, noise: Noise, window: Window, believed: Tensor, generator: torch.Generator
) -> Tensor:
    """Random deviations of the levels (DRAWS, POINTS, tanks) m: x <- F x + q at each instant, F the plant's slopes over
    the first interval, q what levels wander in it.
    """
    tanks, span = len(noise.process_std), float(window.samples.time[1] - window.samples.time[0])
    if bool(torch.isnan(noise.process_std).any()):
        return believed.new_zeros(DRAWS, POINTS, tanks)
    nudge = MOVED * length_scale(observer.network.description)
    lanes = window.state.repeat(tanks + 1, 1)
    lanes[1:, :tanks] += nudge * torch.eye(tanks, dtype=lanes.dtype)
    first = Window(window.samples.stretch(0, 2), lanes, window.number)
    nowhere = torch.full((tanks + 1,), NEVER, dtype=lanes.dtype)
    still = Changes(believed.repeat(tanks + 1, 1), nowhere, torch.zeros(tanks + 1, dtype=torch.bool))
    moved = observer.follow(first, believed, still)[0][:, 0, :tanks]
    slopes = (moved[1:] - moved[0]).mT / nudge
    shock = noise.process_std * math.sqrt(span / noise.interval)
    state, found = moved.new_zeros(DRAWS, tanks), []
    for _ in range(POINTS):
        state = state @ slopes.mT + shock * torch.randn(DRAWS, tanks, generator=generator, dtype=moved.dtype)
        found.append(state)
    return torch.stack(found, dim=1)


def _crossed(path: Tensor, height: float, time: Tensor) -> Tensor:
    """When each path (L, K) first reaches a height, (L,) s; infinite where it does not."""
    above = path >= height
    first = above.to(torch.int8).argmax(dim=1)
    rows, previous = torch.arange(len(path)), (first - 1).clamp(min=0)
    rise = (path[rows, first] - path[rows, previous]).clamp(min=1e-12)
    share = ((height - path[rows, previous]) / rise).clamp(0.0, 1.0)
    moment = time[previous] + share * (time[first] - time[previous])
    return torch.where(above.any(dim=1), torch.where(first == 0, 0.0, moment), torch.inf)


def _limit(tank: str, what: Literal["overflows", "runs dry"], moments: Tensor) -> Limit:
    ordered, count = moments.sort().values, len(moments)
    low, middle, high = (float(ordered[min(int(q * count), count - 1)]) for q in (0.05, 0.5, 0.95))
    return Limit(tank, what, middle, low, high, float(torch.isfinite(moments).double().mean()))
