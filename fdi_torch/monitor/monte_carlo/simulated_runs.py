"""Simulated runs of a plant with faults: a batch at once, with process and measurement noise, open or closed loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.capacity import expect_room
from fdi_torch.monitor.samples import Samples
from fdi_torch.monitor.stepper import PlantState, Stepper, usual_step
from fdi_torch.monitor.switched_plant import ONSET, RAMP, SwitchedNetwork
from fdi_torch.parameters import ParameterName, ParameterSpace
from fdi_torch.plant.network import TankNetwork
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
        colour: float = 0.0,
        controller: Callable[[], Controller] | None = None,
    ) -> None:
        self.network, self.switched = network, SwitchedNetwork(network, space.names)
        self.space, self.inputs, self.levels, self.reading_std = space, inputs, levels, reading_std
        self.sampling, self.wander, self.colour, self.controller = sampling, wander, colour, controller
        step = commensurate_step(usual_step(network.description), sampling)
        self._stepper = Stepper(self.switched, min(sampling, step))
        onsets = [str(ParameterName.parse(name).sibling("onset")) for name in space.names]
        known = [name for name in dict.fromkeys(onsets) if name in self.switched.constants]
        self._onsets = [name for name in known if self._has_memory(name)]
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
        levels, effects = moved.levels.split(
            [self.levels.shape[-1], moved.levels.shape[-1] - self.levels.shape[-1]], -1
        )
        shift = torch.randn(levels.shape, generator=generator, dtype=levels.dtype)
        wandered = torch.cat([(levels + self.wander * shift).clamp(min=0.0), effects], dim=-1)
        return PlantState(wandered, moved.commands, moved.readings)

    def _has_memory(self, onset: str) -> bool:
        prefix = ParameterName.parse(onset).prefix
        return any(p.prefix == prefix and p.effect.memory for p in self.switched.placements)
