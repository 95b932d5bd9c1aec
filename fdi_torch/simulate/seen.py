"""What sensors make of a whole path of levels: straight within a step, late where they are late, and how that moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.plant.effect import Memory
from fdi_torch.plant.network import PlaceValues, TankNetwork
from fdi_torch.plant.signals import Clock
from fdi_torch.simulate.actuation import moved
from fdi_torch.simulate.experiment import Experiment
from fdi_torch.simulate.memory import Chain, Signals, chain, remembered
from fdi_torch.simulate.pointwise import Row, partials


@dataclass(frozen=True)
class Late:
    """How late a channel is: each sample lies at `share` after sample `left` (L, S), of an `interval` in s."""

    left: Tensor
    share: Tensor
    interval: Tensor
    by_theta: Row

    def of(self, x: Tensor) -> Tensor:
        """x (L, S) or (L, M, S), as it was."""
        wide = (lambda t: t) if x.dim() == 2 else (lambda t: t.unsqueeze(1))
        left, share = wide(self.left).expand(x.shape), wide(self.share)
        before = x.gather(-1, left)
        return before + share * (x.gather(-1, left + 1) - before)

    def by_delay(self, x: Tensor) -> Tensor:
        """The slope of `of(x)` (L, S) by the delay, 1/s."""
        return torch.where(self.share > 0, x.gather(-1, self.left) - x.gather(-1, self.left + 1), 0.0) / self.interval


@dataclass(frozen=True)
class Look:
    """Sensors about one path. readings (L, C, S)."""

    readings: Tensor
    stage: Chain
    late: dict[int, Late]
    late_slopes: dict[int, Tensor]
    tanks: Sequence[int]
    samples: Samples

    def along(self, paths: Tensor, moves: Sequence[int]) -> Tensor:
        """How readings move, (L, C, M, S), where levels move by paths (L, tanks, M, K+1), and beside them direction
        q by the parameter moves[q] (-1: none)."""
        signals: list[Tensor | None] = []
        for i, tank in enumerate(self.tanks):
            seen = self.samples.of(paths[:, tank])
            if i in self.late:
                late = self.late[i]
                seen = late.of(seen)
                for q, p in enumerate(moves):
                    slope = late.by_theta[p] if p >= 0 else None
                    if slope is not None:
                        seen[:, q] += self.late_slopes[i] * slope
            signals.append(seen)
        found = self.stage.along(signals, moves)
        still = torch.zeros_like(paths[:, 0, :, :1]).expand(*paths[:, 0].shape[:2], self.readings.shape[-1])
        return torch.stack([still if f is None else f for f in found], dim=1)


class Sight:
    """The sensors of a plant under one experiment. names: of the parameters that may move."""

    def __init__(self, network: TankNetwork, experiment: Experiment, names: Sequence[str]) -> None:
        self.network, self.names = network, names
        self.samples, self.times = Samples(experiment), experiment.sample_times
        intervals = torch.diff(self.times, prepend=2 * self.times[:1] - self.times[1:2])
        self.clock = Clock(self.times - intervals, intervals, experiment.resolution)

    def read(self, path: Tensor, values: PlaceValues) -> Tensor:
        """path (L, tanks, K+1) -> readings (L, C, S)."""
        seen = [self.samples.of(path[:, tank]) for tank in self.network.sensor_tanks()]
        for i, delay in self.network.reading_delays(values).items():
            seen[i] = self._late(delay, len(path), []).of(seen[i])
        shape, stage = (len(path), len(self.times)), _Stage(self, values)
        memory = remembered(stage.step, stage.first, seen, [], self.network.reading_memory(), shape)
        readings = stage.step(seen, tuple(memory), [])[0]
        return torch.stack([r.expand(shape) for r in readings], dim=1)

    def look(self, path: Tensor, values: PlaceValues, theta: Signals) -> Look:
        """The same with slopes; theta: of each name (L, 1)."""
        shape, tanks = (len(path), len(self.times)), self.network.sensor_tanks()
        seen = [self.samples.of(path[:, tank]) for tank in tanks]
        late, late_slopes = {}, {}
        for i, delay in self.network.reading_delays(values).items():
            delayed = lambda x, i=i: [self.network.reading_delays(moved(values, self.names, x))[i]]  # noqa: E731
            late[i] = self._late(delay, len(path), partials(delayed, theta, (len(path), 1))[1][0])
            late_slopes[i] = late[i].by_delay(seen[i])
            seen[i] = late[i].of(seen[i])
        stage = _Stage(self, values)
        found = chain(stage.step, stage.first, seen, theta, self.network.reading_memory(), shape)
        return Look(torch.stack(found.outputs, dim=1), found, late, late_slopes, tanks, self.samples)

    def _late(self, delay: Tensor, lanes: int, by_theta: Row) -> Late:
        """delay (L, 1) s; before the first sample everything was as it is there."""
        times = self.times
        wanted = (times - torch.clamp(delay, min=0.0)).expand(lanes, len(times)).contiguous()
        right = torch.searchsorted(times, wanted).clamp(1, len(times) - 1)
        interval = times[right] - times[right - 1]
        share = torch.where(wanted > times[0], (wanted - times[right - 1]) / interval, 0.0)
        return Late(right - 1, share, interval, by_theta)


@dataclass(frozen=True)
class _Stage:
    of: Sight
    values: PlaceValues

    def step(self, signals: Signals, memory: Memory, theta: Signals) -> tuple[Signals, Memory]:
        return self.of.network.read(signals, memory, self.of.clock, moved(self.values, self.of.names, theta))

    def first(self, signals: Signals, theta: Signals) -> Memory:
        clock = self.of.clock
        at_first = Clock(clock.start[:1], clock.step[:1], clock.resolution)
        return self.of.network.steady_reading_memory(signals, at_first, moved(self.values, self.of.names, theta))


class Samples:
    """Paths on the nodes of an experiment -> the same at its samples."""

    def __init__(self, experiment: Experiment) -> None:
        self.step, self.share = experiment.sample_step, experiment.sample_share
        node = self.step + self.share.round().to(torch.int64)
        on_nodes = bool(((self.share - self.share.round()).abs() < 1e-9).all())
        self.node = node if on_nodes else None
        self.same = on_nodes and torch.equal(node, torch.arange(len(experiment.nodes)))

    def of(self, path: Tensor) -> Tensor:
        """(..., K+1) -> (..., S)."""
        if self.same:
            return path
        if self.node is not None:
            return path[..., self.node]
        return path[..., self.step] * (1.0 - self.share) + path[..., self.step + 1] * self.share
