"""Simulated runs of a plant whose parameters change: many at once, noise of both kinds, open or closed loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.capacity import expect_room
from fdi_torch.monitor.changing import ONSET, RAMP, ChangingNetwork
from fdi_torch.monitor.samples import Samples
from fdi_torch.monitor.stepper import PlantState, Stepper, usual_step
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork

Controller = Callable[[Tensor, Tensor], Tensor]
"""(last readings (R, sensors), seconds since they were taken) -> inputs (R, channels)."""


@dataclass(frozen=True)
class Course:
    """What happens in R runs: parameters go from nominal to theta (R, P) at onset (R,) s, within ramp (R,) s."""

    theta: Tensor
    onset: Tensor
    ramp: Tensor


def fault_free(space: ParameterSpace, runs: int) -> Course:
    """So many runs in which nothing ever happens."""
    theta = space.nominal().expand(runs, -1)
    return Course(theta, torch.full((runs,), 1e30, dtype=theta.dtype), torch.zeros(runs, dtype=theta.dtype))


class Rig:
    """A plant to be run: at rest under `inputs` (channels,), read every `sampling` s with `reading_std` (sensors,) of
    white noise, which a first-order filter of coefficient `colour` may colour; levels wander by `wander` m a sample.

    controller: sets the inputs from the last readings instead. Effects that remember and have an onset of their own
    are given the course's.
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
        colour: float = 0.0,
        controller: Callable[[], Controller] | None = None,
    ) -> None:
        self.network, self.changing = network, ChangingNetwork(network, space.names)
        self.space, self.inputs, self.levels, self.reading_std = space, inputs, levels, reading_std
        self.sampling, self.wander, self.colour, self.controller = sampling, wander, colour, controller
        self._stepper = Stepper(self.changing, min(sampling, usual_step(network.description)))
        onsets = [f"{name.rpartition('.')[0]}.onset" for name in space.names]
        self._onsets = [name for name in dict.fromkeys(onsets) if name in self.changing.constants and self._held(name)]
        names = [*(f"after {name}" for name in space.names), ONSET, RAMP, *self._onsets]
        self._columns = ParameterSpace(self.changing.constants[name] for name in names)

    def run(self, course: Course, samples: int, generator: torch.Generator) -> Samples:
        """Readings (R, samples, sensors); inputs (R, samples, channels) where they are controlled."""
        runs, like = len(course.theta), self.levels
        what = f"{runs:.3g} runs of {samples:.3g} samples"
        expect_room(float(runs) * samples * len(self.reading_std), what, "simulate fewer or shorter ones")
        moment = [course.onset.unsqueeze(1), course.ramp.unsqueeze(1)]
        theta = torch.cat([course.theta, *moment, *[course.onset.unsqueeze(1)] * len(self._onsets)], dim=1)
        values = self.changing.bind(self._columns, theta)
        controller = self.controller() if self.controller else None
        inputs = self.inputs.expand(runs, -1)
        state = self._stepper.start(like.expand(runs, -1), inputs, values)
        noise = torch.zeros(runs, len(self.reading_std), dtype=like.dtype)
        readings, commanded = [], []
        for k in range(samples):
            seen, state = self._stepper.read(state, k * self.sampling, self.sampling, values)
            drawn = torch.randn(noise.shape, generator=generator, dtype=like.dtype)
            noise = self.colour * noise + (1.0 - self.colour**2) ** 0.5 * drawn
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
        shift = torch.randn(moved.levels.shape, generator=generator, dtype=moved.levels.dtype)
        return PlantState((moved.levels + self.wander * shift).clamp(min=0.0), moved.commands, moved.readings)

    def _held(self, onset: str) -> bool:
        prefix = onset.rpartition(".")[0]
        return any(p.prefix == prefix and p.effect.memory for p in self.changing.placements)


class LevelControl:
    """Proportional-integral control of each pump by the level of one sensor, starting from a steady command.

    Of each channel: wanted (channels,) in its sensor's unit, sensors: its index, gain (channels,) or one for all:
    command per reading, reset in 1/s. Commands stay within 0 and `highest`.
    """

    def __init__(
        self,
        steady: Tensor,
        wanted: Tensor,
        sensors: Sequence[int],
        gain: Tensor | float,
        reset: float,
        highest: Tensor | float,
    ) -> None:
        self.steady, self.wanted, self.sensors = steady, wanted, list(sensors)
        self.gain, self.reset, self.highest = gain, reset, torch.as_tensor(highest, dtype=steady.dtype)
        self._sum: Tensor | None = None

    def __call__(self, readings: Tensor, span: Tensor) -> Tensor:
        error = self.wanted - readings[:, self.sensors]
        self._sum = error * span if self._sum is None else self._sum + error * span
        command = self.steady + self.gain * (error + self.reset * self._sum)
        return torch.minimum(command.clamp(min=0.0), self.highest)
