"""What the observer would have seen had some parameters changed at some moment: innovations of hypothetical changes."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.monitor.gain import Gain
from fdi_torch.monitor.samples import Samples
from fdi_torch.monitor.stepper import LONGEST_STEP, Stepper, substeps
from fdi_torch.monitor.whitening import Whitening
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.signals import Clock

Step = Callable[[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class Changes:
    """Hypotheses, one lane each: the parameters go from what is believed to `theta` (L, P) at `onset` (L,) s.

    incipient (L,) bool: not at once but in a straight line, from the onset to the last sample of the window.
    """

    theta: Tensor
    onset: Tensor
    incipient: Tensor

    def share(self, start: float, end: float, last: float) -> Tensor:
        """How far the change has come, as a mean over [start, end], (L,)."""
        abrupt = ((end - self.onset) / (end - start)).clamp(0.0, 1.0)
        middle = 0.5 * (start + end)
        ramp = ((middle - self.onset) / (last - self.onset).clamp(min=end - start)).clamp(0.0, 1.0)
        return torch.where(self.incipient, ramp, abrupt)


class ChangedObserver:
    """An observer with a steady gain, run along a window under many hypotheses at once.

    Where a hypothesis is right its innovations are white: half their sum of squares is its negative log-likelihood
    (prediction-error method; Ljung 1999, ch. 7). believed (P,): values of `space` before the change.
    """

    def __init__(
        self,
        network: TankNetwork,
        space: ParameterSpace,
        gain: Gain,
        whitening: Whitening,
        longest_step: float = LONGEST_STEP,
    ) -> None:
        if network.command_memory() or network.reading_memory():
            lagging = [p.prefix for p in network.placements if p.effect.memory]
            raise ValueError(
                f"expected faults without memory, got {lagging[0]}; leave it out of the monitor's list of faults"
            )
        self.network, self.space, self.gain, self.whitening = network, space, gain, whitening
        self.stepper = Stepper(network, longest_step)
        self._recorded: dict[tuple[int, ...], Step] = {}

    def white(self, samples: Samples, levels: Tensor, believed: Tensor, changes: Changes) -> Tensor:
        """White innovations (L, S, sensors) along one recording, from levels (tanks) before its first correction."""
        white = self.whitening(self.follow(samples, levels, believed, changes)[1])
        white[:, : self.whitening.order] = 0.0
        return torch.nan_to_num(white, nan=0.0)

    def follow(self, samples: Samples, levels: Tensor, believed: Tensor, changes: Changes) -> tuple[Tensor, Tensor]:
        """Corrected levels (L, S, tanks) and innovations (L, S, sensors) along one recording."""
        theta = changes.theta
        times, last = samples.time.tolist(), float(samples.time[-1])
        state = levels.expand(len(theta), -1).contiguous()
        step = self._step(state, samples.input_at(0), theta, samples.readings[0])
        seen, innovations = [], []
        for k, end in enumerate(times):
            start = times[k - 1] if k else end - (times[1] - times[0])
            now = believed + (theta - believed) * changes.share(start, end, last).unsqueeze(-1)
            if k:
                for begin, span, share in substeps(start, end - start, self.stepper.longest)[:-1]:
                    state = self._drift(state, samples.input_at(k - 1, share), begin, span, now)
                begin, span, share = substeps(start, end - start, self.stepper.longest)[-1]
                clock = state.new_tensor([begin, span, end, end - start])
                state, innovation = step(
                    state, samples.input_at(k - 1, share), clock, now, samples.readings[k], state.new_tensor(1.0)
                )
            else:
                clock = state.new_tensor([start, 1.0, end, end - start])
                state, innovation = step(
                    state, samples.input_at(0), clock, now, samples.readings[0], state.new_tensor(0.0)
                )
            seen.append(state)
            innovations.append(innovation)
        return torch.stack(seen, dim=1), torch.stack(innovations, dim=1)

    def space_width(self) -> Tensor:
        """The length of each parameter's range, (P,); its size or 1 where it has none."""
        low, high = self.space.low(), self.space.high()
        typical = self.space.nominal().abs()
        width = torch.where(torch.isfinite(high - low), high - low, torch.where(typical > 0, typical, 1.0))
        return width

    def _drift(self, state: Tensor, inputs: Tensor, begin: float, span: float, now: Tensor) -> Tensor:
        """One integration step without a reading at its end."""
        nothing = state.new_full((len(self.network.description.sensors),), torch.nan)
        clock = state.new_tensor([begin, span, begin + span, span])
        return self._step(state, inputs, now, nothing)(state, inputs, clock, now, nothing, state.new_tensor(1.0))[0]

    def _step(self, state: Tensor, inputs: Tensor, theta: Tensor, reading: Tensor) -> Step:
        """move by one step (times 0 or 1), read, correct; recorded once for each number of lanes."""
        key = tuple(state.shape)
        if key in self._recorded:
            return self._recorded[key]

        def step(x: Tensor, u: Tensor, clock: Tensor, now: Tensor, y: Tensor, moves: Tensor) -> tuple[Tensor, Tensor]:
            values = self.network.bind(self.space, now)
            moved = self.stepper.move(x, u, (), Clock(clock[0], clock[1], clock[1]), values)[0]
            x = x + moves * (moved - x)
            seen = [x[..., tank] for tank in self.network.sensor_tanks()]
            predicted, _ = self.network.read(seen, (), Clock(clock[2] - clock[3], clock[3], clock[3]), values)
            innovation = y - torch.stack(torch.broadcast_tensors(*predicted), dim=-1)
            known = torch.nan_to_num(innovation, nan=0.0)
            gain = self.gain.steady
            for c in range(known.shape[-1]):
                x = x + gain[..., c] * known[..., c : c + 1]
            return torch.clamp(x, min=0.0), innovation

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch announces a successor of its tracer; it does not do this job yet
            clock = state.new_tensor([0.0, 1.0, 1.0, 1.0])
            recorded: Step = torch.jit.trace(
                step, (state, inputs, clock, theta, reading, state.new_tensor(1.0)), check_trace=False
            )
        self._recorded[key] = recorded
        return recorded
