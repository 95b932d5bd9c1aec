"""Simulated recordings: an accurate simulation under planned inputs, and measurement noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Stage
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.scales import length_scale, time_scale
from fdi_torch.recording import Recording
from fdi_torch.simulate.build import BuildError
from fdi_torch.simulate.compiled_engine import CompiledEngine
from fdi_torch.simulate.experiment import lay_out
from fdi_torch.simulate.reference_engine import ReferenceEngine
from fdi_torch.simulate.step_control import StepControl

# In units of the plant's time scale. The smoothing suits steps far shorter than those of any estimator.
RESOLUTION = 0.01
LONGEST_STEP = 1.0
TOLERANCE = 1e-10  # of levels, in units of the plant's length scale


def clean_readings(network: TankNetwork, planned: Recording, values: Mapping[str, float]) -> Float[Tensor, "T N"]:
    """Noise-free readings (T, N) with some constants changed by name, by L-stable steps with a tolerance of 1e-10.

    Without a compiler, an adaptive solver does the same a thousand times slower.
    """
    space = ParameterSpace(network.constants[name] for name in values)
    theta = torch.tensor([[float(value) for value in values.values()]], dtype=planned.time.dtype)
    plant = network.description
    scale, tolerance = time_scale(plant), TOLERANCE * length_scale(plant)
    step_control = StepControl.for_tolerance(tolerance, plant, RESOLUTION * scale)
    engine = CompiledEngine(network, space, lay_out(planned, plant.channels(), LONGEST_STEP * scale, step_control))
    try:
        return engine.readings(theta)[0]
    except BuildError:
        experiment = lay_out(planned, plant.channels(), LONGEST_STEP * scale)
        sharp = replace(experiment, resolution=theta.new_tensor(RESOLUTION * scale))
        reference = ReferenceEngine(network, space, sharp, method="dopri5", rtol=TOLERANCE, atol=0.01 * tolerance)
        return reference.readings(theta)[0]


def noise_level(
    clean: Float[Tensor, "*batch T N"], snr_db: float, definition: str = "variance"
) -> Float[Tensor, "*batch N"]:
    """Standard deviation (*batch, N) of the noise that gives clean readings (*batch, T, N) this signal-to-noise ratio
    in dB.

    sqrt(P 10^(-SNR/10)), with P each output's variance, or its mean square under the definition 'power'.
    """
    power = clean.var(dim=-2, correction=0) if definition == "variance" else clean.square().mean(dim=-2)
    return (power * 10.0 ** (-snr_db / 10.0)).sqrt()


def constant_outputs(
    clean: Float[Tensor, "*batch T N"], plant: PlantDescription, definition: str = "variance"
) -> list[str]:
    """The outputs without a signal, whose signal-to-noise ratio is undefined.

    The root of their power P, as in `noise_level`, is within the errors of the simulation and of its start at rest.
    """
    signal = noise_level(clean, 0.0, definition).reshape(-1, clean.shape[-1]).amin(dim=0)
    error = 2.0 * TOLERANCE * length_scale(plant)
    return [s.column for s, size in zip(plant.sensors, signal.tolist(), strict=True) if size <= error * abs(s.gain)]


def with_noise(
    planned: Recording,
    clean: Float[Tensor, "T N"],
    std: Float[Tensor, " N"],
    generator: torch.Generator,
    network: TankNetwork,
    values: Mapping[str, float] | None = None,
) -> Recording:
    """The recording of clean readings (T, N), without the limits of the sensors, with white noise of standard deviation
    std (N,). values: the constants that were changed for the clean readings.

    A quantizing sensor rounds the noisy reading, and a limited one then limits it.
    """
    noise = torch.randn(clean.shape, generator=generator, dtype=clean.dtype) * std
    outputs = limited(quantized(clean + noise, network, values), network.description)
    return replace(planned, outputs=outputs, mask=torch.isfinite(clean), source="simulated")


def limited(readings: Float[Tensor, "T N"], plant: PlantDescription) -> Float[Tensor, "T N"]:
    """Readings (T, N) limited to the ranges of the plant's sensors."""
    columns = zip(plant.sensors, readings.unbind(-1), strict=True)
    return torch.stack([sensor.clipped(column) for sensor, column in columns], dim=-1)


def quantized(
    readings: Float[Tensor, "T N"], network: TankNetwork, changed: Mapping[str, float] | None = None
) -> Float[Tensor, "T N"]:
    """Readings (T, N) rounded by the plant's quantizing sensors. changed: constants that differ from the plant's."""
    space = ParameterSpace(network.constants[name] for name in changed or {})
    values = network.bind(space, readings.new_tensor([*(changed or {}).values()]))
    columns = list(readings.unbind(-1))
    for placement in network.placements:
        if placement.effect.stage is Stage.READING and placement.effect.quantizes:
            i = [sensor.name for sensor in network.description.sensors].index(placement.location)
            width = placement.effect.resolution(values[placement.prefix])
            if float(width) > 0.0:
                columns[i] = torch.round(columns[i] / width) * width
    return torch.stack(columns, dim=-1)
