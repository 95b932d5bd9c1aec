"""One short window of a recording, fitted on its own: which of the suspects are there, and how large."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from fdi_torch.estimate.diagnosis import fault_flow, sample_noise
from fdi_torch.estimate.fitting import Fitting, readings_of
from fdi_torch.estimate.hybrid import search_box
from fdi_torch.estimate.information import certainty
from fdi_torch.estimate.levenberg_marquardt import RefineSettings, levenberg_marquardt
from fdi_torch.estimate.objectives import Problem, Term
from fdi_torch.plant.constants import reading_span
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.scales import time_scale
from fdi_torch.recording import Recording
from fdi_torch.simulate.engine import Engine, Readings
from fdi_torch.simulate.step_length import choose_step, probe_points

REFINE = RefineSettings(iterations=40, decrease_tolerance=1e-6)
START = 0.3  # of a fault, between nominal and the end of its range
STEP_ERROR = 0.2  # of the simulation, as a share of the sensors' noise: a window is too short for it to add up
LEAST_NOISE = 1e-6  # of a sensor that shows none, as a share of what it reads from floor to rim
NOTICED = 0.05  # a size within this of nominal is none, as a share of the range
TOLD = 0.15  # a standard error beyond this share of the range tells nothing
EMPTY = 0.02  # share of its height below which a tank counts as empty: what drains it then, nothing tells
State = Literal["present", "absent", "cannot tell"]


@dataclass(frozen=True)
class WindowFault:
    """size with its standard error (misfit included) in `unit`, and the flow (m^3/s) that it changes at the window's
    mean levels, None where it is no flow's.
    """

    name: str
    size: float
    std: float
    state: State
    flow: float | None
    unit: str = "1"


@dataclass(frozen=True)
class Window:
    """start, stop in s; misfit: root mean square residual over the sensors' noise."""

    start: float
    stop: float
    faults: tuple[WindowFault, ...]
    misfit: float


def noise_of(recording: Recording, plant: PlantDescription) -> Tensor:
    """(C,) sample-to-sample noise of each sensor."""
    readings = readings_of(recording, plant)
    spans = readings.values.new_tensor([reading_span(plant, sensor) for sensor in plant.sensors])
    return torch.maximum(sample_noise(readings.values, readings.weight), LEAST_NOISE * spans)


def cut_up(recording: Recording, length: float) -> list[Recording]:
    """Windows of `length` s side by side; each shares its last sample with the next one. A short rest is left out."""
    first, last = float(recording.time[0]), float(recording.time[-1])
    if not (last - first) / length < len(recording):
        at_least = f"longer than the sampling interval ({recording.interval:g} s)"
        raise ValueError(f"{recording.source}: expected windows {at_least}, got {length:g} s; lengthen them")
    count = int((last - first) / length + 1e-9)
    return [recording.window(first + k * length, first + (k + 1) * length) for k in range(count)]


def window_step(fittings: Sequence[Fitting], std: Tensor) -> float:
    """The longest step (s) that is right to a fifth of the noise `std` (C,) in the window whose inputs move most."""
    busiest = max(fittings, key=lambda f: float(f.recordings[0].inputs.diff(dim=0).abs().sum()))
    time = busiest.recordings[0].time

    def engine_at(step: float) -> Engine:
        return busiest.engines(step)[0]

    points = probe_points(*search_box(busiest))
    longest, scale = float(time[-1] - time[0]) / 20.0, time_scale(busiest.plant)
    return choose_step(engine_at, points, STEP_ERROR * std, longest, scale, quantile=0.9)


def window_of(fitting: Fitting, std: Tensor, suspects: Collection[str], step: float) -> Window:
    """The fit of one window, from no fault, from all and from each alone of some size. std (C,): the sensors' noise.

    step: of the simulation, s.
    """
    recording, space = fitting.recordings[0], fitting.space
    engine = fitting.engines(step)[0]
    data = readings_of(recording, fitting.plant)
    problem = Problem(space, [Term(engine, data, None, std)], "likelihood")
    low, high = space.low(), space.high()
    is_fault = torch.tensor([name in suspects for name in space.names])
    nominal = space.nominal()
    some = nominal + START * (high - nominal)
    together = torch.stack([nominal, torch.where(is_fault, some, nominal)])
    alone = torch.where(torch.diag(is_fault)[is_fault], some, nominal)
    starts = torch.cat([together, alone])
    refined = levenberg_marquardt(
        lambda theta, lanes: problem.linearise(theta, torch.zeros_like(lanes)), starts, low, high, REFINE
    )
    best = int(torch.nan_to_num(refined.cost, nan=math.inf).argmin())
    theta = refined.theta[best]
    residual = (data.values - engine.readings(theta.unsqueeze(0))[0]) * data.weight / std
    misfit = float(torch.sqrt((residual**2).sum() / data.weight.sum()))
    assert refined.curvature is not None
    held = None if refined.held is None else refined.held[best]
    errors = certainty(refined.curvature[best], held=held).std * max(1.0, misfit)
    levels = torch.stack([_mean_level(fitting, tank.name, data) for tank in fitting.plant.tanks])
    channels = recording.inputs[:, [recording.input_names.index(c) for c in fitting.plant.channels()]].mean(dim=0)
    faults = []
    for i, parameter in enumerate(space):
        if parameter.name in suspects:
            size, error = float(theta[i]), float(errors[i])
            at_end = size >= parameter.high  # the size is larger than that; how large, nothing tells
            empty = _empty(fitting, parameter.name.partition(".")[0], levels)
            state: State = (
                "cannot tell"
                if empty
                else state_of(size - parameter.nominal, error, parameter.high - parameter.nominal)
            )
            error = math.inf if at_end or empty else error
            flow, _ = fault_flow(fitting.networks[0], space, theta, i, levels, channels)
            faults.append(WindowFault(parameter.name, size, error, state, flow, parameter.unit))
    return Window(float(recording.time[0]), float(recording.time[-1]), tuple(faults), misfit)


def _mean_level(fitting: Fitting, tank: str, data: Readings) -> Tensor:
    """Of a window's readings, m; NaN for a tank that no sensor sees, so that it does not pass for an empty one."""
    for i, sensor in enumerate(fitting.plant.sensors):
        if sensor.tank == tank:
            mean = (data.values[:, i] * data.weight[:, i]).sum() / data.weight[:, i].sum().clamp(min=1.0)
            return ((mean - sensor.offset) / sensor.gain).clamp(min=0.0)
    return data.values.new_full((), torch.nan)


def _empty(fitting: Fitting, place: str, levels: Tensor) -> bool:
    """Whether the tank at whose level a fault shows (a pipe's: both) holds next to nothing."""
    pumps = {p.name: {p.target} for p in fitting.plant.pumps}
    pipes = {p.name: {p.source, p.target} for p in fitting.plant.pipes}
    shown = (pumps | pipes).get(place, {place})
    held = [
        float(level) >= EMPTY * tank.height
        for tank, level in zip(fitting.plant.tanks, levels, strict=True)
        if tank.name in shown
    ]
    return bool(held) and not any(held)


def state_of(size: float, std: float, width: float) -> State:
    """A fault is present where its size stands out of its error at 95 % and is worth noticing."""
    if not std < TOLD * width:
        return "cannot tell"
    return "present" if size > max(NOTICED * width, 1.96 * std) else "absent"
