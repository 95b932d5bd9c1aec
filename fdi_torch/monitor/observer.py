"""The Luenberger-like observer with nominal parameters and its residual, y - y_hat (2020 paper, eq. 14)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from fdi_torch.monitor.gain import Gain, linearised, spectral_radius
from fdi_torch.monitor.samples import Samples
from fdi_torch.monitor.stepper import LONGEST_STEP, Move, PlantState, Stepper
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import PlaceValues, TankNetwork

CHECKED_POINTS = 200


@dataclass(frozen=True)
class Observation:
    """What an observer saw: levels (*batch, S, tanks) m after each correction, residual (*batch, S, sensors) = reading
    less prediction, NaN where a reading is missing, and inflation (S, *batch or 1, sensors), see `Gain`.
    """

    time: Tensor
    levels: Tensor
    residual: Tensor
    inflation: Tensor

    @property
    def steady_residual(self) -> Tensor:
        """The residual with its first samples brought to the spread of the later ones."""
        return self.residual / self.inflation


class Observer:
    """x_hat' = f(x_hat, u; theta) + K (y - y_hat), sample by sample: predict exactly, then correct by L (y - y_hat).

    theta (*batch, P) are values of `space`; what is not in it is nominal. A level is never corrected below zero.
    """

    def __init__(
        self,
        network: TankNetwork,
        gain: Gain,
        space: ParameterSpace | None = None,
        theta: Tensor | None = None,
        longest_step: float = LONGEST_STEP,
    ) -> None:
        self.stepper, self.gain = Stepper(network, longest_step), gain
        self.values = bound(network, space, theta)
        self._moves: dict[torch.Size, Move | None] = {}
        self._expect_shape(network)

    def start(self, samples: Samples, levels: Tensor | None = None) -> PlantState:
        """The state before the first sample: given levels (*batch, tanks), or those that the first readings show."""
        if levels is None:
            levels = first_levels(self.stepper.network, samples, self.values)
        return self.stepper.start(levels, samples.input_at(0), self.values)

    def correct(self, state: PlantState, reading: Tensor, k: int, end: float, span: float) -> tuple[PlantState, Tensor]:
        """State and reading (*batch, sensors) at sample k of the run -> corrected state, residual (*batch, sensors)."""
        predicted, state = self.stepper.read(state, end, span, self.values)
        residual = reading - predicted
        known = torch.nan_to_num(residual, nan=0.0)
        gain = self.gain.at(k)
        # Explicit sums: a lane's result must not depend on how many lanes run beside it.
        move = sum(gain[..., c] * known[..., c : c + 1] for c in range(known.shape[-1]))
        levels = torch.clamp(state.levels + move, min=0.0)
        return PlantState(levels, state.commands, state.readings), residual

    def run(self, samples: Samples, levels: Tensor | None = None) -> Observation:
        """Along whole recordings. levels: before the first correction, where known."""
        state = self.start(samples, levels)
        state = replace(state, levels=state.levels.expand(*self._lanes(samples), -1))
        times = samples.time.tolist()
        state, residual = self.correct(state, samples.readings[..., 0, :], 0, times[0], times[1] - times[0])
        rest = self.resume(samples, state, 1)
        return Observation(
            samples.time,
            torch.cat([state.levels.unsqueeze(-2), rest.levels], dim=-2),
            torch.cat([residual.unsqueeze(-2), rest.residual], dim=-2),
            torch.cat([self.gain.inflation_at(0).unsqueeze(-2), rest.inflation], dim=-2),
        )

    def resume(self, samples: Samples, state: PlantState, number: int) -> Observation:
        """From the state after the first sample: what is seen at the others. number: samples seen so far."""
        move = self._recorded(state.levels, samples.input_at(0))
        times = samples.time.tolist()
        seen, residuals, inflation = [], [], []
        for k in range(1, len(samples)):
            span = times[k] - times[k - 1]
            inputs = partial(samples.input_at, k - 1)
            state = self.stepper.advance(state, inputs, times[k - 1], span, self.values, move)
            count = number + k - 1
            state, residual = self.correct(state, samples.readings[..., k, :], count, times[k], span)
            seen.append(state.levels)
            residuals.append(residual)
            inflation.append(self.gain.inflation_at(count))
        return Observation(
            samples.time[1:], torch.stack(seen, -2), torch.stack(residuals, -2), torch.stack(inflation, -2)
        )

    def check_stable(self, samples: Samples, seen: Observation) -> float:
        """The largest spectral radius of the error's transition at the levels visited.

        Raises ValueError where it reaches 1: there the residual would grow by itself.
        """
        span = float(torch.diff(samples.time).median())
        chosen = torch.linspace(0, len(samples) - 1, min(len(samples), CHECKED_POINTS)).long()
        levels = seen.levels[..., chosen, :].reshape(-1, seen.levels.shape[-1])
        inputs = samples.inputs[..., chosen, :].expand(*samples.batch, len(chosen), -1)
        inputs = torch.nan_to_num(inputs).reshape(-1, samples.inputs.shape[-1])
        # Lanes of parameters would multiply the points; stability is checked for the first lane's.
        values = {place: {f: v.reshape(-1)[0] for f, v in own.items()} for place, own in self.values.items()}
        gain = self.gain.steady.reshape(-1, *self.gain.steady.shape[-2:])[0]
        radius = spectral_radius(linearised(self.stepper, levels, inputs, span, values), gain)
        worst = int(radius.argmax())
        if not float(radius[worst]) < 1.0:
            at = float(samples.time[chosen[worst % len(chosen)]])
            raise ValueError(
                f"expected an observer gain that lets errors decay, got one that lets them grow by "
                f"{float(radius[worst]):.3g} a sample at {at:g} s; lower the gain or let it be designed"
            )
        return float(radius[worst])

    def _recorded(self, levels: Tensor, inputs: Tensor) -> Move | None:
        if levels.shape not in self._moves:
            self._moves[levels.shape] = self.stepper.recorded(levels, inputs, self.values)
        return self._moves[levels.shape]

    def _lanes(self, samples: Samples) -> torch.Size:
        """Recordings, lanes of parameters and lanes of gains side by side."""
        values = [v.shape for own in self.values.values() for v in own.values()]
        return torch.broadcast_shapes(samples.batch, self.gain.steady.shape[:-2], *values)

    def _expect_shape(self, network: TankNetwork) -> None:
        wanted = (len(network.description.tanks), len(network.description.sensors))
        if tuple(self.gain.steady.shape[-2:]) != wanted:
            got = tuple(self.gain.steady.shape[-2:])
            raise ValueError(f"expected a gain of {wanted[0]} tanks x {wanted[1]} sensors, got {got[0]} x {got[1]}")


def bound(network: TankNetwork, space: ParameterSpace | None, theta: Tensor | None) -> PlaceValues:
    """Every constant of the plant, those of `space` from theta."""
    if (space is None) != (theta is None):
        raise ValueError("expected a parameter space together with its values, got one of the two; give both or none")
    if space is None or theta is None:
        return network.bind(ParameterSpace(), network.nominal.new_zeros(0))
    return network.bind(space, theta)


def first_levels(network: TankNetwork, samples: Samples, values: PlaceValues) -> Tensor:
    """Levels (*batch, tanks) that the first reading of each sensor shows; the nominal start level where none does."""
    batch = samples.batch
    levels = [level.expand(batch) for level in network.start_levels(values)]
    for c, (sensor, tank) in enumerate(zip(network.description.sensors, network.sensor_tanks(), strict=True)):
        own = values[sensor.name]
        shown = (samples.readings[..., 0, c] - own["offset"]) / own["gain"]
        levels[tank] = torch.where(torch.isfinite(shown), shown.clamp(min=0.0), levels[tank])
    return torch.stack(levels, dim=-1)
