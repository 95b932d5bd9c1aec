"""Whole trajectories at once: the implicit midpoint rule over all steps, linearised and solved by a scan in time.

    h_{k+1} = h_k + dt f((h_k + h_{k+1}) / 2, u_k, theta)

Every step's right-hand side is evaluated in one call, with its derivatives in forward mode; Newton's correction of
the trajectory and its sensitivities to theta then obey one linear recurrence. A Gauss-Newton fit can therefore
correct parameters and trajectory together (Bock, 1987), at the price of one evaluation an iteration and without
compiled code. Error of the rule: dt^2 h'''/24 a second; with 1 s steps on the three tanks below 1e-3 cm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.autograd import forward_ad

from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.effect import Memory
from fdi_torch.plant.network import PlaceValues, TankNetwork
from fdi_torch.plant.signals import Clock
from fdi_torch.simulate.experiment import Experiment
from fdi_torch.simulate.integrate import late
from fdi_torch.simulate.memory import recur, with_tangents
from fdi_torch.simulate.scan import linear_scan


@dataclass(frozen=True)
class Linearised:
    """A trajectory and its neighbourhood.

    levels (L, K+1, tanks) m: the corrected trajectory, slopes (L, K+1, tanks, P) its sensitivity; readings (L, S, C)
    and jacobian (L, S, C, P): the same at the sensors.
    transition (L, K, tanks, tanks) and gain (L, K, tanks, tanks): a disturbance w of the rates over step k adds
    gain_k w to the next level, which transition hands on. defect (L,): the largest correction of a level, m.
    """

    levels: Tensor
    slopes: Tensor
    readings: Tensor
    jacobian: Tensor
    transition: Tensor
    gain: Tensor
    defect: Tensor

    def lanes(self, which: Tensor) -> Linearised:
        """Some of the lanes."""
        return Linearised(*(getattr(self, name)[which] for name in self.__dataclass_fields__))


class Collocation:
    """Readings of a plant and their Jacobian for many parameter vectors, from guesses of their trajectories."""

    def __init__(self, network: TankNetwork, space: ParameterSpace, experiment: Experiment) -> None:
        self.network, self.space, self.experiment = network, space, experiment
        tanks = [f"{t.name}.start_level" for t in network.description.tanks]
        self._start_columns = {space.index(name): i for i, name in enumerate(tanks) if name in space}
        self._moving = [j for j in range(len(space)) if j not in self._start_columns]

    @property
    def clock(self) -> Clock:
        e = self.experiment
        return Clock(e.nodes[:-1], e.steps, e.resolution)

    def linearise(self, theta: Tensor, levels: Tensor) -> Linearised:
        """theta (L, P), levels (L, K+1, tanks) a guess of the trajectory -> one Newton step further, with slopes."""
        middle = 0.5 * (levels[:, :-1] + levels[:, 1:])
        rates, by_level, by_theta = self._rate_slopes(middle, theta)
        step = self.experiment.steps.unsqueeze(-1)
        half = 0.5 * step.unsqueeze(-1) * by_level
        one = torch.eye(middle.shape[-1], dtype=theta.dtype, device=theta.device)
        inverse = torch.linalg.inv(one - half)
        transition, gain = inverse @ (one + half), inverse * step.unsqueeze(-1)
        start, start_slopes = self._start(theta)
        misfit = levels[:, 1:] - levels[:, :-1] - step * rates
        forcing = torch.cat([-(inverse @ misfit.unsqueeze(-1)), gain @ by_theta], dim=-1)
        first = torch.cat([(start - levels[:, 0]).unsqueeze(-1), start_slopes], dim=-1)
        path = linear_scan(transition, forcing, first)
        corrected = levels + path[..., 0]
        slopes, defect = path[..., 1:], path[..., 0].abs().amax(dim=(-1, -2))
        one = torch.eye(theta.shape[-1], dtype=theta.dtype, device=theta.device)
        readings, jacobian = self._read_slopes(corrected, slopes, theta, one)
        return Linearised(corrected, slopes, readings, jacobian, transition, gain, defect)

    def settle(self, theta: Tensor, levels: Tensor, rounds: int = 12, tolerance: float = 1e-7) -> Linearised:
        """Newton steps at fixed theta until no level moves by more than `tolerance` (m)."""
        for _ in range(rounds):
            found = self.linearise(theta, levels)
            levels = found.levels
            if float(found.defect.max()) < tolerance:
                break
        return found

    def rates(self, middle: Tensor, theta: Tensor) -> Tensor:
        """dh/dt (L, K, tanks) at given mid-step levels (L or 1, K, tanks)."""
        values = self.network.bind(self.space, theta.unsqueeze(-2))
        signals, memory, _ = self._commands_before(values, len(theta))
        commands = self.network.commands(signals, memory.unbind(-1), self.clock, values)[0]
        return self._rates(middle, commands, values, theta.shape[:-1])

    def read(self, levels: Tensor, theta: Tensor) -> Tensor:
        """Readings (L, S, C) of given levels (L or 1, K+1, tanks)."""
        lanes = levels.expand(theta.shape[0], *levels.shape[1:])
        values = self.network.bind(self.space, theta.unsqueeze(-2))
        seen, memory, _ = self._readings_before(self._at_samples(lanes), values)
        readings, _ = self.network.read(seen, memory.unbind(-1), self._sample_clock, values)
        return torch.stack([r.expand(seen[0].shape) for r in readings], dim=-1)

    def constant_guess(self, theta: Tensor) -> Tensor:
        """Levels that stay where they start (L, K+1, tanks)."""
        start, _ = self._start(theta)
        return start.unsqueeze(1).expand(-1, len(self.experiment.nodes), -1).clone()

    def read_along(self, levels: Tensor, along: Tensor, theta: Tensor) -> Tensor:
        """How readings (L, S, C, M) change where levels (L, K+1, tanks) move `along` (L, K+1, tanks, M)."""
        return self._read_slopes(levels, along, theta, torch.zeros(along.shape[-1], theta.shape[-1]).to(theta))[1]

    def _start(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        values = self.network.bind(self.space, theta)
        start = torch.stack([h.expand(theta.shape[:-1]) for h in self.network.start_levels(values)], dim=-1)
        slopes = theta.new_zeros(*start.shape, theta.shape[-1])
        for column, tank in self._start_columns.items():
            slopes[:, tank, column] = 1.0
        return start, slopes

    def _rate_slopes(self, middle: Tensor, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Rates (L, K, n), their slopes by level (L, K, n, n) and by theta (L, K, n, P)."""
        n, moving = middle.shape[-1], self._moving
        count = n + len(moving)
        along_levels, along_theta = middle.new_zeros(count, *middle.shape), theta.new_zeros(count, *theta.shape)
        for i in range(n):
            along_levels[i, ..., i] = 1.0
        for row, column in enumerate(moving):
            along_theta[n + row, ..., column] = 1.0
        _, memory, memory_slopes = self._commands_before(self.network.bind(self.space, theta.unsqueeze(-2)), len(theta))
        with forward_ad.dual_level():
            dual = forward_ad.make_dual(theta.expand(count, *theta.shape).contiguous(), along_theta)
            dual_levels = forward_ad.make_dual(middle.expand(count, *middle.shape).contiguous(), along_levels)
            values = self.network.bind(self.space, dual.unsqueeze(-2))
            commands = self._dual_commands(values, memory, memory_slopes, count)
            rates, slopes = forward_ad.unpack_dual(self._rates(dual_levels, commands, values, dual.shape[:-1]))
        by_theta = theta.new_zeros(*rates.shape[1:], theta.shape[-1])
        by_theta[..., moving] = slopes[n:].movedim(0, -1)
        return rates[0], slopes[:n].movedim(0, -1), by_theta

    def _rates(self, middle: Tensor, commands: list[Tensor], values: PlaceValues, lanes: Sequence[int]) -> Tensor:
        rates = self.network.rates(middle.unbind(-1), commands, self.clock, values)
        return torch.stack([r.expand(*lanes, middle.shape[-2]) for r in rates], dim=-1)

    def _channels(self, values: PlaceValues) -> list[Tensor]:
        """Each actuator's channel averaged over each step, late where it is late; broadcasts to (*lanes, K)."""
        e = self.experiment
        delays = self.network.command_delays(values)
        return [
            e.signal.average(e.nodes[:-1], e.steps, channel, delays[i]) if i in delays else e.inputs[:, channel]
            for i, (_, channel) in enumerate(self.network.actuators())
        ]

    def _commands_before(self, values: PlaceValues, lanes: int) -> tuple[list[Tensor], Tensor, Tensor]:
        """Channels, the actuators' memory before each step (L, K, m) and its slope (L, K, m, m)."""
        channels, network, steps = self._channels(values), self.network, len(self.experiment.steps)
        if network.command_memory() == 0:
            nothing = self.experiment.steps.new_zeros(lanes, steps, 0)
            return channels, nothing, nothing.unsqueeze(-1)
        wide = [c.expand(lanes, steps) for c in channels]
        first = network.remember_commands([c[..., :1] for c in wide], self._first_clock, values)
        return wide, *recur(lambda m: network.commands(wide, m, self.clock, values), first, (lanes, steps))

    def _dual_commands(self, values: PlaceValues, memory: Tensor, slopes: Tensor, count: int) -> list[Tensor]:
        """What each actuator makes of its channel over each step, with tangents; broadcasts to (count, L, K)."""
        channels, network = self._channels(values), self.network
        if not memory.shape[-1]:
            return network.commands(channels, (), self.clock, values)[0]
        wide = [c.expand(count, *memory.shape[:-1]) for c in channels]
        first = network.remember_commands([c[..., :1] for c in wide], self._first_clock, values)
        return with_tangents(lambda m: network.commands(wide, m, self.clock, values), first, memory, slopes, count)

    @property
    def _first_clock(self) -> Clock:
        return Clock(self.clock.start[:1], self.clock.step[:1], self.clock.resolution)

    def _at_samples(self, levels: Tensor) -> list[Tensor]:
        """The level at each sensor at the samples, (*lanes, S); straight within a step."""
        e = self.experiment
        share = e.sample_share.unsqueeze(-1)
        seen = levels[..., e.sample_step, :] * (1.0 - share) + levels[..., e.sample_step + 1, :] * share
        return [seen[..., tank] for tank in self.network.sensor_tanks()]

    @property
    def _sample_clock(self) -> Clock:
        times = self.experiment.sample_times
        intervals = torch.diff(times, prepend=2 * times[:1] - times[1:2])
        return Clock(times - intervals, intervals, self.experiment.resolution)

    def _seen(self, levels: list[Tensor], values: PlaceValues) -> list[Tensor]:
        """The level that each sensor sees, late where it is late."""
        seen = list(levels)
        for i, delay in self.network.reading_delays(values).items():
            seen[i] = _late(seen[i], self.experiment.sample_times, delay)
        return seen

    def _first_memory(self, seen: list[Tensor], values: PlaceValues) -> Memory:
        clock = self._sample_clock
        first = Clock(clock.start[:1], clock.step[:1], clock.resolution)
        return self.network.remember_readings([s[..., :1] for s in seen], first, values)

    def _readings_before(self, levels: list[Tensor], values: PlaceValues) -> tuple[list[Tensor], Tensor, Tensor]:
        """What sensors see, their memory before each sample (L, S, m) and its slope (L, S, m, m)."""
        seen, clock = self._seen(levels, values), self._sample_clock
        if self.network.reading_memory() == 0:
            nothing = seen[0].new_zeros(*seen[0].shape, 0)
            return seen, nothing, nothing.unsqueeze(-1)
        first = self._first_memory(seen, values)
        return seen, *recur(lambda m: self.network.read(seen, m, clock, values), first, seen[0].shape)

    def _read_slopes(self, levels: Tensor, slopes: Tensor, theta: Tensor, along: Tensor) -> tuple[Tensor, Tensor]:
        """Readings (L, S, C) and their slopes (L, S, C, M) where levels move by slopes (L, K+1, tanks, M) while theta
        moves by along (M, P).
        """
        plain = self.network.bind(self.space, theta.unsqueeze(-2))
        _, memory, memory_slopes = self._readings_before(self._at_samples(levels), plain)
        count, clock = slopes.shape[-1], self._sample_clock
        with forward_ad.dual_level():
            tangents = along.unsqueeze(1).expand(count, *theta.shape).contiguous()
            dual = forward_ad.make_dual(theta.expand(count, *theta.shape).contiguous(), tangents)
            paths = levels.expand(count, *levels.shape).contiguous()
            path = forward_ad.make_dual(paths, slopes.movedim(-1, 0).contiguous())
            values = self.network.bind(self.space, dual.unsqueeze(-2))
            seen = self._seen(self._at_samples(path), values)
            if memory.shape[-1]:
                first = self._first_memory(seen, values)

                def step(m: Memory) -> tuple[list[Tensor], Memory]:
                    return self.network.read(seen, m, clock, values)

                readings = with_tangents(step, first, memory, memory_slopes, count)
            else:
                readings = self.network.read(seen, (), clock, values)[0]
            stacked = torch.stack([r.expand(seen[0].shape) for r in readings], dim=-1)
            value, found = forward_ad.unpack_dual(stacked)
        return value[0], found.movedim(0, -1)


def _late(seen: Tensor, times: Tensor, delay: Tensor) -> Tensor:
    """`late` with any leading dimensions: seen (*lanes, S), delay that broadcasts to (*lanes, 1)."""
    lanes = seen.shape[:-1]
    delays = delay.expand(*lanes, 1).reshape(-1)
    return late(seen.reshape(-1, seen.shape[-1]).T, times, delays).T.reshape(seen.shape)
