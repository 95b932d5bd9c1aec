"""The simulation block: inputs, faults and noise of a simulated run; and noise of readings as one short text for all
sensors or for each of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, Any, Literal

import torch
from pydantic import BeforeValidator, Field
from torch import Tensor

from fdi_torch.capacity import expect_room
from fdi_torch.config.problems import ConfigError, naming, shown
from fdi_torch.config.recording_config import StartLevels
from fdi_torch.config.strict import Amount, Decibel, Seconds, Strict, quantity_at
from fdi_torch.names import unknown
from fdi_torch.plant.description import PlantDescription, Sensor
from fdi_torch.quantities import parse_quantity
from fdi_torch.recording import Recording
from fdi_torch.simulate.resampling import interpolate
from fdi_torch.simulate.simulated_recording import constant_outputs, noise_level


class InputConfig(Strict):
    value: Amount | None = Field(None, description="constant value, in the unit of the plant's channel")
    steps: list[tuple[Seconds, Amount]] = Field(
        default_factory=list,
        description="[[0 s, 50 cm^3/s], [200 s, 60 cm^3/s], ...]: each value holds from its time on",
    )


def _input(value: Any) -> Any:
    if isinstance(value, int | float | str):
        return {"value": value}
    if not isinstance(value, Mapping | InputConfig):
        example = "{steps: [[0 s, 50 cm^3/s], [200 s, 60 cm^3/s]]}"
        raise ValueError(f"expected a value such as 50 cm^3/s, or {example}, got {shown(value)}")
    return value


def flat_names(value: Any, prefix: str = "") -> Any:
    """{T1: {leak: 0.3}} -> {T1.leak: 0.3}, the form in which --set simulate.faults.T1.leak=0.3 arrives."""
    if not isinstance(value, dict):
        return value
    flat: dict[str, Any] = {}
    for key, inner in value.items():
        name = f"{prefix}{key}"
        flat.update(flat_names(inner, f"{name}.") if isinstance(inner, dict) else {name: inner})
    return flat


def _noise(value: Any) -> Any:
    if not isinstance(value, Mapping | NoiseConfig):
        raise ValueError(f"expected {{std: {{h1: 1 mm}}}} or {{snr_db: 30}}, got {shown(value)}")
    return value


class NoiseConfig(Strict):
    snr_db: Decibel | None = Field(None, description="signal-to-noise ratio of each output, dB")
    definition: Literal["variance", "power"] = Field(
        "variance", description="signal power of the ratio: the output's variance or its mean square"
    )
    std: dict[str, Amount] = Field(default_factory=dict, description="standard deviation by output: {h1: 1 mm}")


class SimulationConfig(Strict):
    inputs: dict[str, Annotated[InputConfig, BeforeValidator(_input)]] = Field(
        default_factory=dict, description="channel: value or steps"
    )
    hold: Literal["zero_order", "linear"] = Field("zero_order", description="course of inputs between samples")
    duration: Seconds = Field(1000.0, gt=0, description="length of the recording, s")
    sample_time: Seconds = Field(1.0, gt=0, description="sampling interval, s")
    start_levels: StartLevels = Field(
        "equilibrium", description="equilibrium (of the fault-free plant), or {T1: 50 cm}"
    )
    faults: Annotated[dict[str, Amount], BeforeValidator(lambda value: flat_names(value))] = Field(
        default_factory=dict, description="values of any parameters, such as T1.leak: 0.3"
    )
    noise: Annotated[NoiseConfig, BeforeValidator(_noise)] = Field(
        default_factory=NoiseConfig, description="added to every output"
    )
    seed: int | None = Field(None, description="seed of the noise; by default the run's seed")


def planned_recording(config: SimulationConfig, plant: PlantDescription) -> Recording:
    """Time and inputs of the run to be simulated; its readings are NaN and masked.

    Raises ConfigError for unknown or missing inputs, and for steps between samples.
    """
    time = _clock(config, plant)
    units = plant.channel_units()
    for name in config.inputs:
        if name not in units:
            raise ConfigError([unknown("a channel of the plant", name, units)], f"simulate.inputs.{name}")
    missing = [name for name in units if name not in config.inputs]
    if missing:
        raise ConfigError(
            [f"expected every channel of the plant, got none for {', '.join(missing)}"], "simulate.inputs"
        )
    columns = [_series(name, config.inputs[name], unit, time, config) for name, unit in units.items()]
    inputs = torch.stack(columns, dim=1) if columns else time.new_zeros(len(time), 0)
    unread = time.new_full((len(time), len(plant.sensors)), torch.nan)
    return plant.recording(time, inputs, unread, hold=config.hold, source="simulated")


def noise_std(config: NoiseConfig, plant: PlantDescription, clean: Tensor) -> Tensor:
    """Standard deviation (N,) of the noise of noise-free outputs (T, N), in their SI units.

    From the signal-to-noise ratio, or as configured.
    """
    names = plant.outputs()
    std = clean.new_zeros(len(names))
    if config.snr_db is not None:
        std = noise_level(clean, config.snr_db, config.definition)
        if constant := constant_outputs(clean, plant, config.definition):
            sentence = f"expected outputs that vary, got a constant {constant[0]}; give std"
            raise ConfigError([sentence], "simulate.noise.snr_db")
    for name, value in config.std.items():
        place = f"simulate.noise.std.{name}"
        if name not in names:
            raise ConfigError([unknown("an output of the plant", name, names)], place)
        std[names.index(name)] = quantity_at(place, value, plant.sensors[names.index(name)].unit)
    return std


def expect_room_for_samples(duration: float, interval: float, columns: int = 1) -> None:
    """Raises ValueError if that many samples of so many columns exceed the memory. duration, interval: s."""
    what = f"{duration / interval:.3g} samples, one every {interval:g} s for {duration:g} s"
    expect_room(columns * duration / interval, what, "simulate a shorter time, or sample more slowly")


def _clock(config: SimulationConfig, plant: PlantDescription) -> Tensor:
    with naming("simulate"):
        columns = 1 + len(plant.channel_units()) + len(plant.sensors)
        expect_room_for_samples(config.duration, config.sample_time, columns)
    intervals = round(config.duration / config.sample_time)
    if intervals < 1 or abs(intervals * config.sample_time - config.duration) > 1e-9 * config.duration:
        expected = f"a multiple of sample_time ({config.sample_time:g} s)"
        raise ConfigError([f"expected {expected}, got {config.duration:g} s"], "simulate.duration")
    return torch.arange(intervals + 1, dtype=torch.float64) * config.sample_time


def _series(name: str, config: InputConfig, unit: str, time: Tensor, run: SimulationConfig) -> Tensor:
    place = f"simulate.inputs.{name}"
    if (config.value is None) == (not config.steps):
        raise ConfigError([f"expected either value or steps, got {'both' if config.steps else 'neither'}"], place)
    if config.value is not None:
        return torch.full_like(time, quantity_at(place, config.value, unit))
    times = torch.tensor([t for t, _ in config.steps], dtype=torch.float64)
    values = torch.tensor([quantity_at(f"{place}.steps", v, unit) for _, v in config.steps], dtype=torch.float64)
    wrong = [f"{b:g} s after {a:g} s" for a, b in pairwise(times.tolist()) if not b > a]
    if wrong or float(times[0]) != 0.0:
        got = wrong[0] if wrong else f"{float(times[0]):g} s first"
        raise ConfigError([f"expected times that start at 0 s and increase, got {got}"], f"{place}.steps")
    if run.hold == "linear":
        return interpolate(time, times, values)
    between = times[(times / run.sample_time - (times / run.sample_time).round()).abs() > 1e-9].tolist()
    if between:
        every = f"(every {run.sample_time:g} s)"
        raise ConfigError([f"expected times at samples {every}, got {between[0]:g} s"], f"{place}.steps")
    return values[torch.searchsorted(times, time + 1e-9 * run.sample_time, right=True) - 1]


def reading_noise(text: str, plant: PlantDescription) -> list[float]:
    """Standard deviation of each sensor's readings in its SI unit.

    '1 mm' refers to the level, for sensors of any unit; '0.01 mA' is for plants with current sensors only; 'p1 = 2 mV,
    h2 = 1 mm' names each sensor. Raises ValueError.
    """
    if "=" not in text:
        return [_std(text, sensor) for sensor in plant.sensors]
    given = {name.strip(): amount.strip() for name, _, amount in (part.partition("=") for part in text.split(","))}
    names = [sensor.name for sensor in plant.sensors]
    for name in given:
        if name not in names:
            raise ValueError(f"noise: {unknown('a sensor', name, names)}")
    missing = [name for name in names if name not in given]
    if missing:
        raise ValueError(f"noise: expected one for each of {', '.join(names)}, got none for {', '.join(missing)}")
    return [_std(given[sensor.name], sensor) for sensor in plant.sensors]


def _std(text: str, sensor: Sensor) -> float:
    try:
        std = parse_quantity(text, sensor.unit)
    except ValueError:
        try:
            std = parse_quantity(text, "m") * abs(sensor.gain)
        except ValueError:
            raise ValueError(
                f"noise of {sensor.name}: expected a standard deviation of the reading ({sensor.unit}) or of the "
                f"level, with a unit such as '1 mm', got '{text}'"
            ) from None
    if not std > 0:
        raise ValueError(f"noise of {sensor.name}: expected a positive standard deviation, got '{text}'")
    return std
