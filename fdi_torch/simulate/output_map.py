"""The output map: readings of the sensors for a whole path of levels, and its linearisation.

Levels are linear within a step, and delayed by the sensors' dead times.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from fdi_torch.plant.network import PlaceValues, TankNetwork
from fdi_torch.plant.signals import Clock
from fdi_torch.simulate.actuation import NetworkStage, with_parameters
from fdi_torch.simulate.experiment import Experiment
from fdi_torch.simulate.linearised_stage import LinearisedStage, Row, Signals, linearise_stage, partials, solve_memory


@dataclass(frozen=True)
class DelayedSignal:
    """The delay of one channel: each delayed sample is at the fraction `share` after sample `left` (L, S), of
    `interval` s.
    """

    left: Tensor
    share: Tensor
    interval: Tensor
    by_theta: Row

    def of(self, x: Float[Tensor, "L *M S"]) -> Float[Tensor, "L *M S"]:
        """The delayed signal, or several ones."""
        wide = (lambda t: t) if x.dim() == 2 else (lambda t: t.unsqueeze(1))
        left, share = wide(self.left).expand(x.shape), wide(self.share)
        before = x.gather(-1, left)
        return before + share * (x.gather(-1, left + 1) - before)

    def by_delay(self, x: Float[Tensor, "L S"]) -> Float[Tensor, "L S"]:
        """Slope of the delayed signal by the delay, per s."""
        return torch.where(self.share > 0, x.gather(-1, self.left) - x.gather(-1, self.left + 1), 0.0) / self.interval


@dataclass(frozen=True)
class LinearisedOutputs:
    """The readings (L, C, S) of one path and their linearisation."""

    readings: Tensor
    stage: LinearisedStage
    late: dict[int, DelayedSignal]
    late_slopes: dict[int, Tensor]
    tanks: Sequence[int]
    samples: SampleGrid

    def along(self, paths: Float[Tensor, "L tanks M nodes"], moves: Sequence[int]) -> Float[Tensor, "L C M S"]:
        """Change of the readings (L, C, M, S) along M directions.

        paths: change of the levels (L, tanks, M, K+1). moves: index of the parameter that changes by one along each
        direction, -1 for none.
        """
        signals: list[Tensor | None] = []
        for i, tank in enumerate(self.tanks):
            level_change = self.samples.of(paths[:, tank])
            if i in self.late:
                late = self.late[i]
                level_change = late.of(level_change)
                for q, p in enumerate(moves):
                    slope = late.by_theta[p] if p >= 0 else None
                    if slope is not None:
                        level_change[:, q] += self.late_slopes[i] * slope
            signals.append(level_change)
        changes = self.stage.along(signals, moves)
        zero = torch.zeros_like(paths[:, 0, :, :1]).expand(*paths[:, 0].shape[:2], self.readings.shape[-1])
        return torch.stack([zero if c is None else c for c in changes], dim=1)


class OutputMap:
    """The sensors of a plant in one experiment. names: the parameters by which readings are differentiated."""

    def __init__(self, network: TankNetwork, experiment: Experiment, names: Sequence[str]) -> None:
        self.network, self.names = network, names
        self.samples, self.times = SampleGrid(experiment), experiment.sample_times
        intervals = torch.diff(self.times, prepend=2 * self.times[:1] - self.times[1:2])
        self.clock = Clock(self.times - intervals, intervals, experiment.resolution.max())

    def read(self, path: Float[Tensor, "L tanks nodes"], values: PlaceValues) -> Float[Tensor, "L C S"]:
        """Readings (L, C, S) of levels path (L, tanks, K+1)."""
        measured = [self.samples.of(path[:, tank]) for tank in self.network.sensor_tanks()]
        for i, delay in self.network.reading_delays(values).items():
            measured[i] = self._late(delay, len(path), []).of(measured[i])
        shape, stage = (len(path), len(self.times)), self._stage(values)
        memory = solve_memory(stage.step, stage.first, measured, [], self.network.reading_memory, shape)
        readings = stage.step(measured, tuple(memory), [])[0]
        return torch.stack([r.expand(shape) for r in readings], dim=1)

    def look(self, path: Float[Tensor, "L tanks nodes"], values: PlaceValues, theta: Signals) -> LinearisedOutputs:
        """The readings and their linearisation; theta: each named parameter (L, 1)."""
        shape, tanks = (len(path), len(self.times)), self.network.sensor_tanks()
        measured = [self.samples.of(path[:, tank]) for tank in tanks]
        late, late_slopes = {}, {}
        for i, delay in self.network.reading_delays(values).items():
            delayed = lambda x, i=i: [self.network.reading_delays(with_parameters(values, self.names, x))[i]]  # noqa: E731
            late[i] = self._late(delay, len(path), partials(delayed, theta, (len(path), 1))[1][0])
            late_slopes[i] = late[i].by_delay(measured[i])
            measured[i] = late[i].of(measured[i])
        stage = self._stage(values)
        stage_outputs = linearise_stage(stage.step, stage.first, measured, theta, self.network.reading_memory, shape)
        return LinearisedOutputs(
            torch.stack(stage_outputs.outputs, dim=1), stage_outputs, late, late_slopes, tanks, self.samples
        )

    def _stage(self, values: PlaceValues) -> NetworkStage:
        return NetworkStage(self.network.read, self.network.steady_reading_memory, self.clock, self.names, values)

    def _late(self, delay: Tensor, lanes: int, by_theta: Row) -> DelayedSignal:
        """The delay (L, 1) s of one sensor; its level is constant before the first sample."""
        times = self.times
        delayed_times = (times - torch.clamp(delay, min=0.0)).expand(lanes, len(times)).contiguous()
        right = torch.searchsorted(times, delayed_times).clamp(1, len(times) - 1)
        interval = times[right] - times[right - 1]
        share = torch.where(delayed_times > times[0], (delayed_times - times[right - 1]) / interval, 0.0)
        return DelayedSignal(right - 1, share, interval, by_theta)


class SampleGrid:
    """Interpolation of paths on an experiment's nodes to its samples."""

    def __init__(self, experiment: Experiment) -> None:
        self.step, self.share = experiment.sample_step, experiment.sample_share
        node = self.step + self.share.round().to(torch.int64)
        on_nodes = bool(((self.share - self.share.round()).abs() < 1e-9).all())
        self.node = node if on_nodes else None
        self.same = on_nodes and torch.equal(node, torch.arange(len(experiment.nodes)))
        self.one_per_step = torch.equal(self.step, torch.arange(len(experiment.nodes) - 1))

    def of(self, path: Float[Tensor, "*batch nodes"]) -> Float[Tensor, "*batch S"]:
        """The path at the samples."""
        if self.same:
            return path
        if self.node is not None:
            return _at(path, self.node)
        if self.one_per_step:
            before, after = path[..., :-1], path[..., 1:]
        else:
            before, after = _at(path, self.step), _at(path, self.step + 1)
        return before * (1.0 - self.share) + after * self.share


def _at(path: Tensor, nodes: Tensor) -> Tensor:
    """The path at some nodes. PyTorch gathers several times as fast as it indexes the last dimension."""
    return path.gather(-1, nodes.expand(*path.shape[:-1], -1))
