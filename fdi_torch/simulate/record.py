"""Simulated recordings: a plant run tightly under planned inputs, and read with noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.effect import Stage
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.scales import length_scale, time_scale
from fdi_torch.recording import Recording
from fdi_torch.simulate.build import BuildError
from fdi_torch.simulate.compiled import CompiledEngine
from fdi_torch.simulate.experiment import lay_out
from fdi_torch.simulate.integrate import ReferenceEngine
from fdi_torch.simulate.own_steps import OwnSteps

# In units of the plant's time scale. Roots and rims are drawn as for steps far shorter than any estimator's.
RESOLUTION = 0.01
LONGEST_STEP = 1.0
TOLERANCE = 1e-10  # of levels, in units of the plant's length scale


def clean_readings(network: TankNetwork, planned: Recording, values: Mapping[str, float]) -> Tensor:
    """Noise-free readings (T, N) with some constants changed by name, in L-stable steps right to 1e-10.

    Where there is no compiler, and so no fast engine, an adaptive solver does it in a thousand times as long.
    """
    space = ParameterSpace(network.constants[name] for name in values)
    theta = torch.tensor([[float(value) for value in values.values()]], dtype=planned.time.dtype)
    plant = network.description
    pace, exact = time_scale(plant), TOLERANCE * length_scale(plant)
    own = OwnSteps.within(exact, plant, RESOLUTION * pace)
    engine = CompiledEngine(network, space, lay_out(planned, plant.channels(), LONGEST_STEP * pace, own))
    try:
        return engine.readings(theta)[0]
    except BuildError:
        experiment = lay_out(planned, plant.channels(), LONGEST_STEP * pace)
        sharp = replace(experiment, resolution=theta.new_tensor(RESOLUTION * pace))
        slow = ReferenceEngine(network, space, sharp, method="dopri5", rtol=TOLERANCE, atol=0.01 * exact)
        return slow.readings(theta)[0]


def noise_level(clean: Tensor, snr_db: float, definition: str = "variance") -> Tensor:
    """Standard deviation (*batch, N) of the noise that makes clean readings (*batch, T, N) have this SNR in dB.

    sqrt(P 10^(-SNR/10)); P is each output's variance, or under 'power' its mean square.
    """
    power = clean.var(dim=-2, correction=0) if definition == "variance" else clean.square().mean(dim=-2)
    return (power * 10.0 ** (-snr_db / 10.0)).sqrt()


def with_noise(
    planned: Recording, clean: Tensor, std: Tensor, generator: torch.Generator, network: TankNetwork
) -> Recording:
    """The recording that sensors with white noise of standard deviation std (N,) make of clean readings (T, N).

    A sensor that rounds does so after the noise, in steps of its nominal size.
    """
    noise = torch.randn(clean.shape, generator=generator, dtype=clean.dtype) * std
    return replace(planned, outputs=rounded(clean + noise, network), mask=torch.isfinite(clean), source="simulated")


def rounded(readings: Tensor, network: TankNetwork) -> Tensor:
    """Readings (T, N) in the steps that the plant's rounding sensors have."""
    values = network.bind(ParameterSpace(), readings.new_zeros(0))
    columns = list(readings.unbind(-1))
    for placement in network.placements:
        if placement.effect.stage is Stage.READING and placement.effect.quantizes:
            i = [sensor.name for sensor in network.description.sensors].index(placement.location)
            width = placement.effect.resolution(values[placement.prefix])
            if float(width) > 0.0:
                columns[i] = torch.round(columns[i] / width) * width
    return torch.stack(columns, dim=-1)
