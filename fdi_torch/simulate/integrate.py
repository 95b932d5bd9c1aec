"""The reference engine: the plant integrated with torchdiffeq. This file is the only importer of torchdiffeq."""

from __future__ import annotations

from bisect import bisect_right

import torch
from torch import Tensor
from torch.autograd import forward_ad

from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.effect import Memory
from fdi_torch.plant.network import PlaceValues, TankNetwork
from fdi_torch.plant.signals import Clock
from fdi_torch.simulate.engine import Readings, expect_problems, gram_of, moments_of
from fdi_torch.simulate.experiment import Experiment


class ReferenceEngine:
    """Readings of many parameter vectors at once, by torchdiffeq's fixed-step RK4 (3/8 rule) or an adaptive solver.

    method: 'rk4' for populations, or any adaptive method of torchdiffeq for one run (rtol, atol in m).
    Adaptive solvers share one step over the batch, so a member would depend on its neighbours: lanes run one by one.
    """

    name = "reference"

    def __init__(
        self,
        network: TankNetwork,
        space: ParameterSpace,
        experiment: Experiment,
        method: str = "rk4",
        rtol: float = 1e-10,
        atol: float = 1e-12,
        why: str = "",
    ) -> None:
        self.network, self.space, self.experiment, self.why = network, space, experiment, why
        self.method, self.rtol, self.atol = method, rtol, atol

    def readings(self, theta: Tensor) -> Tensor:
        """theta (*batch, P) -> readings (*batch, S, sensors) in SI."""
        batch = theta.shape[:-1]
        lanes = theta.reshape(theta.shape[:-1].numel(), theta.shape[-1])
        if self.method == "rk4":
            result = self._run(lanes)
        else:
            result = torch.cat([self._run(lane) for lane in lanes.split(1)], dim=1)
        return result.movedim(1, 0).reshape(*batch, *result.shape[::2])

    def levels(self, theta: Tensor) -> Tensor:
        """theta (*batch, P) -> tank levels at the samples (*batch, S, tanks), m."""
        lanes = theta.reshape(theta.shape[:-1].numel(), theta.shape[-1])
        levels = self._sample(*self._integrate(self.network.bind(self.space, lanes), len(lanes)))
        return levels.movedim(1, 0).reshape(*theta.shape[:-1], *levels.shape[::2])

    def linearise(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """theta (*batch, P) -> readings (*batch, S, sensors), their Jacobian (*batch, S, sensors, P), forward mode.

        Slow: torch differentiates each operation in Python; the other engines differentiate the equations beforehand.
        """
        count = theta.shape[-1]
        tangents = torch.eye(count, dtype=theta.dtype, device=theta.device)
        tangents = tangents.reshape(count, *[1] * (theta.dim() - 1), count).expand(count, *theta.shape)
        with forward_ad.dual_level():
            dual = forward_ad.make_dual(theta.expand(count, *theta.shape).contiguous(), tangents.contiguous())
            readings, slopes = forward_ad.unpack_dual(self.readings(dual))
        if slopes is None:
            slopes = torch.zeros_like(readings)
        return readings[0], slopes.movedim(0, -1)

    def moments(self, theta: Tensor, data: Readings) -> Tensor:
        """As `Engine.moments`."""
        expect_problems(theta, data)
        return moments_of(self.readings(theta), data)

    def gram(self, theta: Tensor, data: Readings) -> Tensor:
        """As `Engine.gram`."""
        expect_problems(theta, data)
        return gram_of(*self.linearise(theta), data)

    def _run(self, lanes: Tensor) -> Tensor:
        """lanes (L, P) -> readings (S, L, sensors)."""
        values = self.network.bind(self.space, lanes)
        levels = self._sample(*self._integrate(values, len(lanes)))
        return self._read(levels, values)

    def _clock(self, start: Tensor, step: Tensor) -> Clock:
        return Clock(start, step, self.experiment.resolution)

    def _integrate(self, values: PlaceValues, lanes: int) -> tuple[Tensor, Tensor, PlaceValues]:
        """Levels at the nodes (K+1, L, tanks), what the actuators do over the steps (K, L, actuators)."""
        nodes, steps = self.experiment.nodes, self.experiment.steps
        commands = self._commands(values, lanes)
        start = torch.stack([h.expand(lanes) for h in self.network.start_levels(values)], dim=-1)
        edges = nodes.tolist()

        def rates(t: Tensor, levels: Tensor) -> Tensor:
            k = min(max(bisect_right(edges, float(t)) - 1, 0), len(edges) - 2)
            return self.network(levels, commands[k], self._clock(nodes[k], steps[k]), values)

        # `perturb` asks for the slopes just inside each step, so that a switch at its end is not seen early.
        options = {"perturb": True} if self.method == "rk4" else {"jump_t": nodes[1:-1]}
        import torchdiffeq  # half a second, which no command has to wait for that does not ask for this engine

        levels = torchdiffeq.odeint(
            rates, start, nodes, method=self.method, rtol=self.rtol, atol=self.atol, options=options
        )
        return levels, commands, values

    def _commands(self, values: PlaceValues, lanes: int) -> Tensor:
        """What each pump and valve makes of its channel over each step, (K, L, actuators)."""
        starts, steps = self.experiment.nodes[:-1], self.experiment.steps
        delays = self.network.command_delays(values)
        channels = {}
        for i, (_, channel) in enumerate(self.network.actuators()):
            mean = self.experiment.inputs[:, channel : channel + 1].expand(-1, lanes)
            if i in delays:
                begin = starts.unsqueeze(1).expand(-1, lanes)
                mean = self.experiment.signal.average(begin, steps.unsqueeze(1), channel, delays[i])
            channels[i] = mean
        if not channels:
            return starts.new_zeros(len(starts), lanes, 0)
        stacked = torch.stack([channels[i] for i in range(len(channels))], dim=-1)
        return self._through_actuators(stacked, values)

    def _through_actuators(self, channels: Tensor, values: PlaceValues) -> Tensor:
        starts, steps = self.experiment.nodes[:-1], self.experiment.steps
        if self.network.command_memory() == 0:
            clock = self._clock(starts.unsqueeze(1), steps.unsqueeze(1))
            actual, _ = self.network.commands(channels.unbind(-1), (), clock, values)
            return torch.stack([a.expand(channels.shape[:-1]) for a in actual], dim=-1)
        memory = self.network.remember_commands(channels[0].unbind(-1), self._clock(starts[0], steps[0]), values)
        rows = []
        for k in range(len(steps)):
            actual, memory = self.network.commands(
                channels[k].unbind(-1), memory, self._clock(starts[k], steps[k]), values
            )
            rows.append(torch.stack([a.expand(channels.shape[1]) for a in actual], dim=-1))
        return torch.stack(rows)

    def _sample(self, levels: Tensor, commands: Tensor, values: PlaceValues) -> Tensor:
        """Levels at the samples (S, L, tanks): the nodes themselves, or the cubic through both ends' levels, slopes."""
        e = self.experiment
        left, right = levels[e.sample_step], levels[e.sample_step + 1]
        inside = (e.sample_share > 0.0) & (e.sample_share < 1.0)
        if not bool(inside.any()):
            return torch.where((e.sample_share > 0.0).reshape(-1, 1, 1), right, left)
        step = e.steps[e.sample_step].reshape(-1, 1)
        clock = self._clock(e.nodes[e.sample_step].reshape(-1, 1), step)
        held = commands[e.sample_step]
        slope_left = self.network(left, held, clock, values)
        slope_right = self.network(right, held, clock, values)
        cubic = hermite(left, right, slope_left, slope_right, step.unsqueeze(-1), e.sample_share.reshape(-1, 1, 1))
        exact = torch.where((e.sample_share > 0.0).reshape(-1, 1, 1), right, left)
        return torch.where(inside.reshape(-1, 1, 1), cubic, exact)

    def _read(self, levels: Tensor, values: PlaceValues) -> Tensor:
        """Tank levels at the samples (S, L, tanks) -> readings (S, L, sensors)."""
        seen = [levels[..., tank] for tank in self.network.sensor_tanks()]
        for i, delay in self.network.reading_delays(values).items():
            seen[i] = late(seen[i], self.experiment.sample_times, delay)
        times = self.experiment.sample_times
        intervals = torch.diff(times, prepend=2 * times[:1] - times[1:2])
        if self.network.reading_memory() == 0:
            clock = self._clock((times - intervals).unsqueeze(1), intervals.unsqueeze(1))
            readings, _ = self.network.read(seen, (), clock, values)
            return torch.stack([r.expand(levels.shape[:2]) for r in readings], dim=-1)
        clock = self._clock(times[0] - intervals[0], intervals[0])
        memory: Memory = self.network.remember_readings([s[0] for s in seen], clock, values)
        rows = []
        for k in range(len(times)):
            clock = self._clock(times[k] - intervals[k], intervals[k])
            readings, memory = self.network.read([s[k] for s in seen], memory, clock, values)
            rows.append(torch.stack([r.expand(levels.shape[1]) for r in readings], dim=-1))
        return torch.stack(rows)


def hermite(
    left: Tensor, right: Tensor, slope_left: Tensor, slope_right: Tensor, step: Tensor, share: Tensor
) -> Tensor:
    """The cubic through both ends' values and slopes, at `share` (0..1) of the step."""
    rest = 1.0 - share
    bend_left = share * rest * rest
    bend_right = share * share * rest
    blend = share * share * (3.0 - 2.0 * share)
    return left + blend * (right - left) + step * (bend_left * slope_left - bend_right * slope_right)


def late(series: Tensor, times: Tensor, delay: Tensor) -> Tensor:
    """series (S, L) at `times` (S,), each lane seen `delay` (L,) s later; before the first sample it is that sample."""
    wanted = times.unsqueeze(1) - torch.clamp(delay, min=0.0).expand(series.shape[1])
    right = torch.searchsorted(times, wanted.detach().contiguous()).clamp(1, len(times) - 1)
    left = right - 1
    before, after = series.gather(0, left), series.gather(0, right)
    share = (wanted - times[left]) / (times[right] - times[left])
    return before + torch.where(wanted > times[0], share, 0.0) * (after - before)
