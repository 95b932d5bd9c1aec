"""The Luenberger-like observer with fixed parameters and its residual, y - y_hat (2020 paper, eq. 14)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from fdi_torch.monitor.observer_gain import Gain
from fdi_torch.monitor.samples import ABSENT, Samples
from fdi_torch.monitor.stepper import Stepper
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.inverted_sensor import levels_from_readings
from fdi_torch.plant.network import PlaceValues, TankNetwork
from fdi_torch.simulate.build import BuildError
from fdi_torch.simulate.compiled_engine import CompiledEngine
from fdi_torch.simulate.engine import Readings
from fdi_torch.simulate.injection import Injection, lay_out_samples
from fdi_torch.simulate.traced_engine import TracedEngine


@dataclass(frozen=True)
class ObserverRun:
    """Result at each sample: state (L, S, order + M) after the correction, the network's states in m, then memory of
    actuators and sensors; expected (L, S, sensors): predicted readings before the correction.
    """

    state: Tensor
    expected: Tensor


def run_observers(
    network: TankNetwork,
    space: ParameterSpace,
    theta: Tensor,
    samples: Samples,
    start: Tensor,
    gains: Tensor,
    longest_step: float,
    from_first: bool,
) -> ObserverRun:
    """Run L observers in parallel.

    theta (L, P), start (L, tanks) or (L, order + M), gains (S', order, sensors) or (L, S', order, sensors). samples:
    inputs (T, channels), readings (T, sensors) or (L, T, sensors), NaN where missing. from_first: True if `start` is
    the state before the correction at the first sample (S' = T), False if after it (S' = T - 1).
    """
    readings = samples.readings if from_first else samples.readings[..., 1:, :]
    # The same time resolution for all calls, so that the result does not depend on how the samples are divided.
    experiment = lay_out_samples(samples.time, samples.inputs, samples.hold, longest_step, from_first, longest_step)
    kind = CompiledEngine if _compiles(network, space.names) else TracedEngine
    data = Readings(readings, torch.isfinite(readings).to(readings.dtype))
    lane_theta = theta.unsqueeze(-2) if readings.dim() > 2 else theta
    memory = start[:, network.order :] if start.shape[1] > network.order else None
    injection = Injection(gains, start[:, : network.order], memory)
    out = kind(network, space, experiment).observe(lane_theta, data, injection)
    out = out.reshape(len(theta), *out.shape[-2:])
    split = out.shape[-1] - len(network.description.sensors)
    return ObserverRun(out[..., :split], out[..., split:])


@lru_cache(maxsize=64)
def _compiles(network: TankNetwork, names: tuple[str, ...]) -> bool:
    """Whether the plant can be compiled; without a compiler, torch does the same more slowly."""
    nodes = torch.zeros(2, 1, dtype=torch.float64)
    blank = lay_out_samples(torch.arange(2.0, dtype=torch.float64), nodes, "zero_order", 1.0)
    try:
        CompiledEngine(network, ParameterSpace(network.constants[name] for name in names), blank).prepare()
    except BuildError:
        return False
    return True


@dataclass(frozen=True)
class Observation:
    """States and residuals of an observer.

    state (*batch, S, order + M) after each correction: the network's states in m, of which the levels of the tanks are
    the first, then the memory of actuators and sensors. residual (*batch, S, sensors): reading minus prediction, NaN
    where a reading is missing. inflation (S, *batch or 1, sensors): see `Gain`.
    """

    time: Tensor
    state: Tensor
    residual: Tensor
    inflation: Tensor

    @property
    def steady_residual(self) -> Tensor:
        """The residual with its first samples scaled to the steady variance."""
        return self.residual / self.inflation


class Observer:
    """x_hat' = f(x_hat, u; theta) + K (y - y_hat): predict over each interval, then correct by L (y - y_hat).

    theta (*batch, P): values of `space`; all other constants are nominal. Levels are never corrected below zero.
    """

    def __init__(
        self,
        network: TankNetwork,
        gain: Gain,
        space: ParameterSpace | None = None,
        theta: Tensor | None = None,
        longest_step: float | None = None,
    ) -> None:
        self.stepper, self.gain = Stepper(network, longest_step), gain
        self.values = bind_parameters(network, space, theta)
        self.space = space or ParameterSpace()
        self.theta = network.nominal.new_zeros(0) if theta is None else theta
        self._expect_shape(network)

    def run(self, samples: Samples, levels: Tensor | None = None) -> Observation:
        """Run along recordings with the same inputs. levels (*batch, tanks): from the first readings if None."""
        network = self.stepper.network
        lanes = self._lanes(samples)
        if levels is None:
            levels = initial_levels(network, samples, self.values)
        flat = lanes.numel()
        readings = samples.readings
        if samples.batch:
            readings = readings.expand(*lanes, *readings.shape[-2:]).reshape(flat, *readings.shape[-2:])
        ran = run_observers(
            network,
            self.space,
            self.theta.expand(*lanes, -1).reshape(flat, -1),
            replace(samples, readings=readings),
            levels.expand(*lanes, -1).reshape(flat, -1),
            self._gains(len(samples), lanes),
            self.stepper.longest,
            from_first=True,
        )
        residual = (readings - ran.expected).reshape(*lanes, len(samples), -1)
        state = ran.state.reshape(*lanes, len(samples), -1)
        return Observation(samples.time, state, residual, self.gain.spread(0, len(samples)))

    def _gains(self, count: int, lanes: torch.Size) -> Tensor:
        """Gains (S, order, sensors), or (L, S, order, sensors) if they differ by batch member."""
        table = self.gain.table(0, count)
        if table.dim() == 3:
            return table
        return (
            table.movedim(0, -3).expand(*lanes, -1, -1, -1).reshape(lanes.numel(), *table.shape[:1], *table.shape[-2:])
        )

    def _lanes(self, samples: Samples) -> torch.Size:
        """Batch shape of recordings, parameters and gains together."""
        values = [v.shape for own in self.values.values() for v in own.values()]
        # numpy's: torch's loads a library for symbolic shapes, which takes a second
        return torch.Size(np.broadcast_shapes(samples.batch, self.gain.steady.shape[:-2], *values))

    def _expect_shape(self, network: TankNetwork) -> None:
        shape = (network.order, len(network.description.sensors))
        if tuple(self.gain.steady.shape[-2:]) != shape:
            got = tuple(self.gain.steady.shape[-2:])
            raise ValueError(f"expected a gain of {shape[0]} states x {shape[1]} sensors, got {got[0]} x {got[1]}")


def bind_parameters(network: TankNetwork, space: ParameterSpace | None, theta: Tensor | None) -> PlaceValues:
    """The constants of the plant, those of `space` from theta (*batch, P). Raises ValueError for one of the two."""
    if (space is None) != (theta is None):
        raise ValueError("expected a parameter space together with its values, got one of the two; give both or none")
    if space is None or theta is None:
        return network.bind(ParameterSpace(), network.nominal.new_zeros(0))
    return network.bind(space, theta)


def initial_levels(network: TankNetwork, samples: Samples, values: PlaceValues) -> Tensor:
    """Levels (*batch, tanks) from the first reading of each sensor within ABSENT samples; nominal without one."""
    start = [level.expand(samples.batch) for level in network.start_levels(values)]
    readings = samples.readings[..., :ABSENT, :]
    first = torch.isfinite(readings).to(torch.int8).argmax(dim=-2, keepdim=True)
    of_each = readings.gather(-2, first).squeeze(-2).unbind(-1)
    levels = levels_from_readings(network, of_each, start, samples.time[0], values)
    return torch.stack(torch.broadcast_tensors(*levels), dim=-1)
