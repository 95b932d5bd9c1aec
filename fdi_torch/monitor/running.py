"""An observer run along samples by the fastest engine there is: many lanes of parameters, gains or readings at once."""

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
class Ran:
    """After each sample: state (L, S, tanks + M), levels in m and then what actuators and sensors remember; expected
    (L, S, sensors), the reading before the correction.
    """

    state: Tensor
    expected: Tensor


def run_lanes(
    network: TankNetwork,
    space: ParameterSpace,
    theta: Tensor,
    samples: Samples,
    start: Tensor,
    gains: Tensor,
    longest_step: float,
    from_first: bool,
) -> Ran:
    """theta (L, P), start (L, tanks) or (L, tanks + M), gains (S', tanks, sensors) or (L, S', tanks, sensors).

    samples: inputs (T, channels), readings (T, sensors) or (L, T, sensors), NaN where missing. from_first: whether the
    first sample is read and corrected (S' = T), or is where `start` holds after its correction (S' = T - 1).
    """
    readings = samples.readings if from_first else samples.readings[..., 1:, :]
    # One resolution for all stretches: what an observer sees does not depend on how many samples come at once.
    experiment = lay_out_samples(samples.time, samples.inputs, samples.hold, longest_step, from_first, longest_step)
    kind = CompiledEngine if _compiles(network, space.names) else TracedEngine
    data = Readings(readings, torch.isfinite(readings).to(readings.dtype))
    own = theta.unsqueeze(-2) if readings.dim() > 2 else theta
    tanks = len(network.description.tanks)
    memory = start[:, tanks:] if start.shape[1] > tanks else None
    injection = Injection(gains, start[:, :tanks], memory)
    out = kind(network, space, experiment).observe(own, data, injection)
    out = out.reshape(len(theta), *out.shape[-2:])
    split = out.shape[-1] - len(network.description.sensors)
    return Ran(out[..., :split], out[..., split:])


@lru_cache(maxsize=64)
def _compiles(network: TankNetwork, names: tuple[str, ...]) -> bool:
    """Whether the plant is there as compiled code; without a compiler the same is done by torch, slowly."""
    nodes = torch.zeros(2, 1, dtype=torch.float64)
    blank = lay_out_samples(torch.arange(2.0, dtype=torch.float64), nodes, "zero_order", 1.0)
    try:
        CompiledEngine(network, ParameterSpace(network.constants[name] for name in names), blank).prepare()
    except BuildError:
        return False
    return True
