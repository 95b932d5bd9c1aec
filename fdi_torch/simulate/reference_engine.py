"""The reference engine: the plant integrated with torchdiffeq. This is the only file that imports torchdiffeq."""

from __future__ import annotations

from bisect import bisect_right
from contextlib import AbstractContextManager, nullcontext
from copy import copy

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd import forward_ad

from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.effect import Memory
from fdi_torch.plant.network import PlaceValues, TankNetwork
from fdi_torch.plant.signals import Clock
from fdi_torch.simulate.engine import Engine, expect_columns, expect_no_gradient
from fdi_torch.simulate.experiment import Experiment
from fdi_torch.simulate.forward_mode import ZeroSlopes, constants_with_slopes, directions, with_slope


class ReferenceEngine(Engine):
    """Readings of many parameter vectors at once, by torchdiffeq's fixed-step RK4 (3/8 rule) or an adaptive solver.

    method: 'rk4' for populations, or any adaptive method of torchdiffeq for single runs (rtol; atol in m). Adaptive
    solvers share one step over the batch, which would make a lane depend on its neighbours; lanes therefore run one by
    one. every_node: an adaptive solver restarts at each node and not only where an actuator switches; levels at the
    nodes are then ends of steps rather than interpolated.
    """

    name = "reference"
    arithmetic: AbstractContextManager[object] = nullcontext()

    def __init__(
        self,
        network: TankNetwork,
        space: ParameterSpace,
        experiment: Experiment,
        method: str = "rk4",
        rtol: float = 1e-10,
        atol: float = 1e-12,
        why: str = "",
        every_node: bool = True,
    ) -> None:
        super().__init__(network, space, experiment, why)
        self.method, self.rtol, self.atol, self.every_node = method, rtol, atol, every_node

    def readings(self, theta: Float[Tensor, "*batch P"]) -> Float[Tensor, "*batch S C"]:
        expect_columns(self, theta)
        batch = theta.shape[:-1]
        lanes = theta.reshape(batch.numel(), theta.shape[-1])
        if self.method == "rk4":
            result = self._run(lanes)
        else:
            result = torch.cat([self._run(lane) for lane in lanes.split(1)], dim=1)
        return result.movedim(1, 0).reshape(*batch, *result.shape[::2])

    def levels(self, theta: Float[Tensor, "*batch P"]) -> Float[Tensor, "*batch S tanks"]:
        expect_columns(self, theta)
        lanes = theta.reshape(theta.shape[:-1].numel(), theta.shape[-1])
        states = self._sample(*self._integrate(self.network.bind(self.space, lanes), len(lanes)))
        levels = states[..., : len(self.network.description.tanks)]
        return levels.movedim(1, 0).reshape(*theta.shape[:-1], *levels.shape[::2])

    def linearise(
        self, theta: Float[Tensor, "*batch P"]
    ) -> tuple[Float[Tensor, "*batch S C"], Float[Tensor, "*batch S C P"]]:
        """Levels and slopes are integrated together; torch differentiates each operation of the right-hand side."""
        expect_no_gradient(self, theta, "linearise")
        lanes = theta.detach().reshape(theta.shape[:-1].numel(), theta.shape[-1])
        parts = [self._run_with_slopes(p) for p in ([lanes] if self.method == "rk4" else lanes.split(1))]
        readings, slopes = (torch.cat(each, dim=1) for each in zip(*parts, strict=True))
        readings = readings.movedim(1, 0)
        shape = (*theta.shape[:-1], *readings.shape[1:])
        return readings.reshape(shape), slopes.movedim(1, 0).reshape(*shape, theta.shape[-1])

    def _run_with_slopes(self, lanes: Tensor) -> tuple[Tensor, Tensor]:
        """lanes (L, P) -> readings (S, L, sensors) and slopes (S, L, sensors, P), from one copy of the lanes per
        parameter.
        """
        with forward_ad.dual_level():
            engine = copy(self)
            engine.experiment, engine.arithmetic = self.experiment.mapped(with_slope), ZeroSlopes()
            readings, slopes = forward_ad.unpack_dual(engine._run(directions(lanes)))
        return readings[:, : len(lanes)], slopes.unflatten(1, (lanes.shape[-1], len(lanes))).movedim(1, -1)

    def _run(self, lanes: Tensor) -> Tensor:
        """lanes (L, P) -> readings (S, L, sensors), with slopes if the lanes have them."""
        values = self.network.bind(self.space, lanes)
        if forward_ad.unpack_dual(lanes)[1] is not None:
            values = constants_with_slopes(values)
        levels, commands, values = self._integrate(values, len(lanes))
        with self.arithmetic:
            return self._read(self._sample(levels, commands, values), values)

    def _clock(self, start: Tensor, step: Tensor) -> Clock:
        return Clock(start, step, self.experiment.resolution)

    def _integrate(self, values: PlaceValues, lanes: int) -> tuple[Tensor, Tensor, PlaceValues]:
        """States at the nodes (K+1, L, order), actuator outputs over the steps (K, L, actuators), and the bound
        values.
        """
        e = self.experiment
        with self.arithmetic:
            commands = self._commands(values, lanes)
            levels, first = self.network.start_levels(values), self._clock(e.nodes[0], e.steps[0])
            state = self.network.with_steady_states(levels, commands[0].unbind(-1), first, values)
            start, slopes = forward_ad.unpack_dual(torch.stack([x.expand(lanes) for x in state], dim=-1))
        instants = e.nodes.detach()
        edges, held = instants.tolist(), commands.unbind()
        clocks = [self._clock(begin, step) for begin, step in zip(e.nodes[:-1].unbind(), e.steps.unbind(), strict=True)]

        def rates(t: Tensor, state: Tensor) -> Tensor:
            k = min(max(bisect_right(edges, float(t.detach())) - 1, 0), len(edges) - 2)
            if slopes is None:
                return self.network(state, held[k], clocks[k], values)
            with self.arithmetic:
                rate = self.network(with_slope(*state.unbind()), held[k], clocks[k], values)
                return torch.stack([*forward_ad.unpack_dual(rate)])

        # `perturb` evaluates slopes just inside each step, so that a switch at its end does not act early.
        restarts = instants[1:-1]
        if not self.every_node:
            restarts = restarts[(torch.diff(commands.detach(), dim=0) != 0).flatten(1).any(dim=1)]
        options = {"perturb": True} if self.method == "rk4" else {"jump_t": restarts}
        import torchdiffeq  # takes half a second, which commands without this engine avoid

        initial = start if slopes is None else torch.stack([start, slopes])
        states = torchdiffeq.odeint(
            rates, initial, instants, method=self.method, rtol=self.rtol, atol=self.atol, options=options
        )
        return states if slopes is None else with_slope(*states.unbind(1)), commands, values

    def _commands(self, values: PlaceValues, lanes: int) -> Tensor:
        """Output of each pump and valve over each step, (K, L, actuators)."""
        starts, steps = self.experiment.nodes[:-1], self.experiment.steps
        delays = self.network.command_delays(values)
        means = []
        for i, (_, channel) in enumerate(self.network.actuators()):
            mean = self.experiment.inputs[:, channel : channel + 1].expand(-1, lanes)
            if i in delays:
                begin = starts.unsqueeze(1).expand(-1, lanes)
                mean = self.experiment.signal.average(begin, steps.unsqueeze(1), channel, delays[i])
            means.append(mean)
        if not means:
            return starts.new_zeros(len(starts), lanes, 0)
        return self._actuator_outputs(torch.stack(means, dim=-1), values)

    def _actuator_outputs(self, channels: Tensor, values: PlaceValues) -> Tensor:
        starts, steps = self.experiment.nodes[:-1], self.experiment.steps
        if self.network.command_memory == 0:
            clock = self._clock(starts.unsqueeze(1), steps.unsqueeze(1))
            outputs, _ = self.network.commands(channels.unbind(-1), (), clock, values)
            return torch.stack([a.expand(channels.shape[:-1]) for a in outputs], dim=-1)
        memory = self.network.steady_command_memory(channels[0].unbind(-1), self._clock(starts[0], steps[0]), values)
        rows = []
        for k in range(len(steps)):
            outputs, memory = self.network.commands(
                channels[k].unbind(-1), memory, self._clock(starts[k], steps[k]), values
            )
            rows.append(torch.stack([a.expand(channels.shape[1]) for a in outputs], dim=-1))
        return torch.stack(rows)

    def _sample(self, levels: Tensor, commands: Tensor, values: PlaceValues) -> Tensor:
        """States at the samples (S, L, order): those at the nodes, or a cubic Hermite interpolation within a step."""
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
        """States at the samples (S, L, order) -> readings (S, L, sensors)."""
        measured = [levels[..., tank] for tank in self.network.sensor_tanks()]
        for i, delay in self.network.reading_delays(values).items():
            measured[i] = late(measured[i], self.experiment.sample_times, delay)
        times = self.experiment.sample_times
        intervals = self.experiment.sample_intervals
        if self.network.reading_memory == 0:
            clock = self._clock((times - intervals).unsqueeze(1), intervals.unsqueeze(1))
            readings, _ = self.network.read(measured, (), clock, values)
            return torch.stack([r.expand(levels.shape[:2]) for r in readings], dim=-1)
        clock = self._clock(times[0] - intervals[0], intervals[0])
        memory: Memory = self.network.steady_reading_memory([s[0] for s in measured], clock, values)
        rows = []
        for k in range(len(times)):
            clock = self._clock(times[k] - intervals[k], intervals[k])
            readings, memory = self.network.read([s[k] for s in measured], memory, clock, values)
            rows.append(torch.stack([r.expand(levels.shape[1]) for r in readings], dim=-1))
        return torch.stack(rows)


def hermite(
    left: Tensor, right: Tensor, slope_left: Tensor, slope_right: Tensor, step: Tensor, share: Tensor
) -> Tensor:
    """Cubic Hermite interpolation between values and slopes at both ends, at the fraction `share` (0..1) of the
    step.
    """
    remaining = 1.0 - share
    bend_left = share * remaining * remaining
    bend_right = share * share * remaining
    blend = share * share * (3.0 - 2.0 * share)
    return left + blend * (right - left) + step * (bend_left * slope_left - bend_right * slope_right)


def late(series: Float[Tensor, "S L"], times: Float[Tensor, " S"], delay: Float[Tensor, "#L"]) -> Float[Tensor, "S L"]:
    """series (S, L) at times (S,), delayed by `delay` (L,) s with linear interpolation; constant before the first
    sample.
    """
    delayed_times = times.unsqueeze(1) - torch.clamp(delay, min=0.0).expand(series.shape[1])
    right = torch.searchsorted(times, delayed_times.detach().contiguous()).clamp(1, len(times) - 1)
    left = right - 1
    before, after = series.gather(0, left), series.gather(0, right)
    share = (delayed_times - times[left]) / (times[right] - times[left])
    return before + torch.where(delayed_times > times[0], share, 0.0) * (after - before)
