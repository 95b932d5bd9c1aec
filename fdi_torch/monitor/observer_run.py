"""Batched run of observers along samples with the fastest available engine."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from fdi_torch.monitor.samples import Samples
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork
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
