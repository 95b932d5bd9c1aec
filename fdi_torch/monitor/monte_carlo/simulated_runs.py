"""Simulated runs of a plant with faults: a batch at once, with process and measurement noise, under level control with
moving set points or under commands that change; and the tasks of a Monte Carlo validation on them, each of seconds to a
minute and with its own seed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.capacity import expect_room
from fdi_torch.monitor.samples import Samples
from fdi_torch.monitor.stepper import PlantState, Stepper, usual_step
from fdi_torch.monitor.switched_plant import ONSET, RAMP, SwitchedNetwork, own_onsets
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.scales import time_scale
from fdi_torch.simulate.step_length import commensurate_step

Controller = Callable[[Tensor, Tensor], Tensor]
"""(last readings (R, sensors), seconds since they were taken) -> inputs (R, channels)."""


@dataclass(frozen=True)
class FaultSchedule:
    """Faults of R runs: the parameters change from nominal to theta (R, P) at onset (R,) s, within ramp (R,) s."""

    theta: Tensor
    onset: Tensor
    ramp: Tensor


def fault_free_schedule(space: ParameterSpace, runs: int) -> FaultSchedule:
    """Schedule of runs without a fault."""
    theta = space.nominal().expand(runs, -1)
    return FaultSchedule(theta, torch.full((runs,), 1e30, dtype=theta.dtype), torch.zeros(runs, dtype=theta.dtype))


class SimulatedRig:
    """A simulated plant that starts in equilibrium under `inputs` (channels,).

    It is read every `sampling` s with measurement noise of standard deviation reading_std (sensors,), which a
    first-order filter with coefficient `colour` may correlate. wander: process noise of the levels, m per sample.
    controller: computes the inputs from the last readings. Effects with a memory and an onset parameter get the onset
    of the schedule.
    """

    def __init__(
        self,
        network: TankNetwork,
        space: ParameterSpace,
        inputs: Tensor,
        levels: Tensor,
        reading_std: Tensor,
        sampling: float = 1.0,
        wander: float = 0.0,
        correlation: float = 0.0,
        controller: Callable[[], Controller] | None = None,
    ) -> None:
        self.network, self.switched = network, SwitchedNetwork(network, space.names)
        self.space, self.inputs, self.levels, self.reading_std = space, inputs, levels, reading_std
        self.sampling, self.wander, self.correlation, self.controller = sampling, wander, correlation, controller
        step = commensurate_step(usual_step(network.description), sampling)
        self._stepper = Stepper(self.switched, min(sampling, step))
        self._onsets = own_onsets(network, space).values()
        names = [*(f"after {name}" for name in space.names), ONSET, RAMP, *self._onsets]
        self._columns = ParameterSpace(self.switched.constants[name] for name in names)

    def run(self, schedule: FaultSchedule, samples: int, generator: torch.Generator) -> Samples:
        """Readings (R, samples, sensors); inputs (R, samples, channels) if a controller sets them."""
        runs, like = len(schedule.theta), self.levels
        what = f"{runs:.3g} runs of {samples:.3g} samples"
        expect_room(float(runs) * samples * len(self.reading_std), what, "simulate fewer or shorter ones")
        timing = [schedule.onset.unsqueeze(1), schedule.ramp.unsqueeze(1)]
        theta = torch.cat([schedule.theta, *timing, *[schedule.onset.unsqueeze(1)] * len(self._onsets)], dim=1)
        values = self.switched.bind(self._columns, theta)
        controller = self.controller() if self.controller else None
        inputs = self.inputs.expand(runs, -1)
        state = self._stepper.start(like.expand(runs, -1), inputs, values)
        noise = torch.zeros(runs, len(self.reading_std), dtype=like.dtype)
        readings, commanded = [], []
        for k in range(samples):
            seen, state = self._stepper.read(state, k * self.sampling, self.sampling, values)
            drawn = torch.randn(noise.shape, generator=generator, dtype=like.dtype)
            noise = self.correlation * noise + (1.0 - self.correlation**2) ** 0.5 * drawn
            readings.append(seen + self.reading_std * noise)
            if controller is not None:
                inputs = controller(readings[-1], like.new_tensor(self.sampling))
            commanded.append(inputs)
            state = self._moved(state, inputs, k * self.sampling, values, generator)
        time = self.sampling * torch.arange(samples, dtype=like.dtype)
        stacked = torch.stack(commanded, dim=1) if controller is not None else self.inputs.expand(samples, -1)
        return Samples(time, stacked, torch.stack(readings, dim=1))

    def _moved(
        self, state: PlantState, inputs: Tensor, time: float, values: object, generator: torch.Generator
    ) -> PlantState:
        moved = self._stepper.advance(state, lambda share: inputs, time, self.sampling, values)  # type: ignore[arg-type]
        if not self.wander:
            return moved
        levels, effects = moved.levels.split(
            [self.levels.shape[-1], moved.levels.shape[-1] - self.levels.shape[-1]], -1
        )
        shift = torch.randn(levels.shape, generator=generator, dtype=levels.dtype)
        wandered = torch.cat([(levels + self.wander * shift).clamp(min=0.0), effects], dim=-1)
        return PlantState(wandered, moved.commands, moved.readings)


# Closed-loop rate of a level control (flow per level error, over the tank's area) and its reset rate, 1/s, on a plant
# whose time scale is 1 s.
RATE, RESET = 0.09375, 0.01
MINUTE, ROUNDING = 60.0, 1e-9  # time between changes, in units of the plant's time scale


class LevelControl:
    """Proportional-integral level control, one loop per pump, starting from a steady command.

    set_points (channels,) in the sensors' units; sensors: index of each loop's sensor; gain (channels,) or scalar:
    command per unit of reading; reset: integral action, 1/s. Commands are limited to 0 .. `highest`.
    """

    def __init__(
        self,
        steady: Tensor,
        set_points: Tensor,
        sensors: Sequence[int],
        gain: Tensor | float,
        reset: float,
        highest: Tensor | float,
    ) -> None:
        self.steady, self.set_points, self.sensors = steady, set_points, list(sensors)
        self.gain, self.reset, self.highest = gain, reset, torch.as_tensor(highest, dtype=steady.dtype)
        self._sum: Tensor | None = None

    def __call__(self, readings: Tensor, span: Tensor) -> Tensor:
        error = self.set_points - readings[:, self.sensors]
        self._sum = error * span if self._sum is None else self._sum + error * span
        command = self.steady + self.gain * (error + self.reset * self._sum)
        return torch.minimum(command.clamp(min=0.0), self.highest)


def moving_set_points(
    plant: PlantDescription, steady: Tensor, levels: Tensor, swing: float
) -> Callable[[], Controller]:
    """Level control of the pumped tanks with set points that change by up to `swing` m every minute, on a plant
    whose time scale is 1 s.

    steady (channels,): commands at equilibrium, one for each pump; levels (tanks,) m there. Raises ValueError if pumps
    share a channel, or a pumped tank has no sensor.
    """
    pumps, tanks = plant.pumps, [t.name for t in plant.tanks]
    if [p.channel for p in pumps] != list(plant.channels()):
        raise ValueError(f"closed loop: expected a channel for each pump, got {', '.join(plant.channels())}")
    reading = [next((i for i, s in enumerate(plant.sensors) if s.tank == p.target), -1) for p in pumps]
    if -1 in reading:
        tank = pumps[reading.index(-1)].target
        raise ValueError(f"closed loop: expected a sensor at every tank that is pumped into, got none at {tank}")
    sensors, pace = [plant.sensors[i] for i in reading], time_scale(plant)
    fed = [tanks.index(p.target) for p in pumps]
    resting, area = levels[fed], levels.new_tensor([plant.tanks[i].area for i in fed])
    slope, offset, pumped = (
        levels.new_tensor(x) for x in ([s.gain for s in sensors], [s.offset for s in sensors], [p.gain for p in pumps])
    )
    gain, highest = RATE / pace * area / (slope * pumped), levels.new_tensor([p.max_flow for p in pumps])

    def make() -> Controller:
        controller = LevelControl(steady, resting, reading, gain, RESET / pace, highest / pumped)
        swings = _swings(steady, pace)

        def command(readings: Tensor, span: Tensor) -> Tensor:
            controller.set_points = slope * (resting + swing * swings(span)) + offset
            return controller(readings, span)

        return command

    return make


def moving_commands(plant: PlantDescription, steady: Tensor, share: float) -> Callable[[], Controller]:
    """Open loop: commands (channels,) that change by up to `share` of themselves every 60 time scales of the plant."""

    def make() -> Controller:
        swings = _swings(steady, time_scale(plant))
        return lambda readings, span: (steady * (1.0 + share * swings(span))).expand(len(readings), -1)

    return make


def _swings(like: Tensor, pace: float) -> Callable[[Tensor], Tensor]:
    """Time passed since the last call, s -> a share of a swing for each channel, with a sign that alternates each
    minute; pace: of the plant.
    """
    clock = 0.0

    def after(span: Tensor) -> Tensor:
        nonlocal clock
        clock += float(span)
        minute = int(clock / (MINUTE * pace) + ROUNDING)
        signs = torch.tensor([1.0 if (minute + i) % 2 else -1.0 for i in range(len(like))], dtype=like.dtype)
        return signs * (0.4 + 0.3 * (minute % 3))

    return after


Numbers = Mapping[str, float | list[float] | list[str]]


@dataclass(frozen=True)
class Task:
    """group: plan and table row to which the numbers belong. compute: carries the task out."""

    group: str
    compute: Callable[[], Numbers]


def seeded_generator(*numbers: int) -> torch.Generator:
    """A random generator that is determined by the numbers."""
    seed = 0
    for number in numbers:
        seed = (1_000_003 * seed + number + 1) % 2**62
    return torch.Generator().manual_seed(seed)


def quantiles(values: list[float], shares: tuple[float, ...]) -> list[float]:
    """Empirical quantiles (order statistics); infinite values count as the largest."""
    order = sorted(values)
    return [order[min(int(share * len(order)), len(order) - 1)] for share in shares] if order else [float("nan")]
