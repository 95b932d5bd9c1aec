"""Controllers of simulated runs: level control with moving set points, and open-loop commands that change."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from fdi_torch.monitor.monte_carlo.simulated_runs import Controller
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.scales import time_scale

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
        controller, clock = LevelControl(steady, resting, reading, gain, RESET / pace, highest / pumped), [0.0]

        def command(readings: Tensor, span: Tensor) -> Tensor:
            clock[0] += float(span)
            minute = int(clock[0] / (MINUTE * pace) + ROUNDING)
            signs = torch.tensor([1.0 if (minute + i) % 2 else -1.0 for i in range(len(pumps))], dtype=levels.dtype)
            controller.set_points = slope * (resting + swing * signs * (0.4 + 0.3 * (minute % 3))) + offset
            return controller(readings, span)

        return command

    return make


def moving_commands(plant: PlantDescription, steady: Tensor, share: float) -> Callable[[], Controller]:
    """Open loop: commands (channels,) that change by up to `share` of themselves every minute, on a plant whose time
    scale is 1 s.
    """
    pace = time_scale(plant)

    def make() -> Controller:
        clock = [0.0]

        def command(readings: Tensor, span: Tensor) -> Tensor:
            clock[0] += float(span)
            minute = int(clock[0] / (MINUTE * pace) + ROUNDING)
            signs = torch.tensor([1.0 if (minute + i) % 2 else -1.0 for i in range(len(steady))], dtype=steady.dtype)
            now = steady * (1.0 + share * signs * (0.4 + 0.3 * (minute % 3)))
            return now.expand(len(readings), -1)

        return command

    return make
