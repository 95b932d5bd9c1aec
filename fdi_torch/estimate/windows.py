"""Estimates of the suspected faults in each short window of a recording, and the intervals in which a fault is present.

Consecutive windows in which a fault is present are merged into one interval (stretch) with one size.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from fdi_torch.estimate.diagnosis import fault_flow
from fdi_torch.estimate.fitting import Fitting, readings_of
from fdi_torch.estimate.hybrid import search_box
from fdi_torch.estimate.information import certainty
from fdi_torch.estimate.levenberg_marquardt import RefineSettings, levenberg_marquardt
from fdi_torch.estimate.objectives import Problem, Term
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.constants import reading_span
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.scales import time_scale
from fdi_torch.recording import Recording
from fdi_torch.sample_noise import sample_noise
from fdi_torch.simulate.engine import Engine, Readings
from fdi_torch.simulate.step_length import choose_step, probe_points, step_ladder

REFINE = RefineSettings(iterations=40, decrease_tolerance=1e-6)
START_SIZE = 0.3  # initial size of a fault, as a fraction of its range above nominal
STEP_ERROR = 0.2  # admissible integration error, as a fraction of the sensor noise; it cannot accumulate in a window
NOISE_FLOOR = 1e-6  # lower limit of the sensor noise, as a fraction of the reading span from floor to rim
SIGNIFICANT_SIZE = 0.05  # as a fraction of the range; a smaller deviation from nominal does not count as a fault
INFORMATIVE_STD = 0.15  # a fault is undecidable if its standard error exceeds this fraction of the range
EMPTY_LEVEL = 0.02  # fraction of its height below which a tank counts as empty; a leak is then unobservable
State = Literal["present", "absent", "cannot tell"]


@dataclass(frozen=True)
class WindowFault:
    """Estimate of one fault in one window.

    size, std: size and standard error, inflated by the misfit, in `unit`. std is infinite if the size is at its upper
    bound or its tank is empty. flow: change of flow at the window's mean levels, m^3/s; None if the fault
    does not change a flow.
    """

    name: str
    size: float
    std: float
    state: State
    flow: float | None
    unit: str = "1"


@dataclass(frozen=True)
class Window:
    """Result for one window. start, stop: s. misfit: root mean square of the residuals divided by the sensor noise."""

    start: float
    stop: float
    faults: tuple[WindowFault, ...]
    misfit: float


@dataclass(frozen=True)
class Stretch:
    """Time interval in which a fault was present without interruption.

    start, stop: s. size, std: merged estimate and standard error, in `unit`; std is infinite if most windows have no
    finite one. flow: mean change of flow, m^3/s; None if the fault does not change a flow.
    """

    name: str
    start: float
    stop: float
    size: float
    std: float
    flow: float | None
    unit: str = "1"


def noise_of(recording: Recording, plant: PlantDescription) -> Float[Tensor, " C"]:
    """Sample-to-sample noise of each sensor, (C,), in its reading's unit, limited from below."""
    readings = readings_of(recording, plant)
    spans = readings.values.new_tensor([reading_span(plant, sensor) for sensor in plant.sensors])
    return torch.maximum(sample_noise(readings.values, readings.weight), NOISE_FLOOR * spans)


def cut_up(recording: Recording, length: float) -> list[Recording]:
    """Divide a recording into consecutive windows of `length` s; neighbours have one sample in common.

    An incomplete last window is dropped. Raises ValueError if a window is not longer than the sampling interval.
    """
    first, last = float(recording.time[0]), float(recording.time[-1])
    if not (last - first) / length < len(recording):
        at_least = f"longer than the sampling interval ({recording.interval:g} s)"
        raise ValueError(f"{recording.source}: expected windows {at_least}, got {length:g} s; lengthen them")
    count = int((last - first) / length + 1e-9)
    return [recording.window(first + k * length, first + (k + 1) * length) for k in range(count)]


def window_step(fittings: Sequence[Fitting], std: Float[Tensor, " C"]) -> float:
    """Longest integration step (s) whose error is within STEP_ERROR times the sensor noise `std` (C,).

    It is determined on the window with the largest total variation of the inputs.
    """
    most_excited = max(fittings, key=lambda f: float(f.recordings[0].inputs.diff(dim=0).abs().sum()))
    recording = most_excited.recordings[0]

    def engine_at(step: float) -> Engine:
        return most_excited.engines(step)[0]

    points = probe_points(*search_box(most_excited))
    longest = float(recording.time[-1] - recording.time[0]) / 20.0
    ladder = step_ladder(recording.interval, time_scale(most_excited.plant), longest)
    return choose_step(engine_at, points, STEP_ERROR * std, ladder, quantile=0.9)


def window_of(fitting: Fitting, std: Float[Tensor, " C"], suspects: Collection[str], step: float) -> Window:
    """Fit one window and decide which faults are present.

    The fit starts from no fault, from all faults together and from each fault alone, and the best optimum is taken.
    std (C,): sensor noise. suspects: names of the fault parameters. step: integration step, s.
    """
    recording, space = fitting.recordings[0], fitting.space
    engine = fitting.engines(step)[0]
    data = readings_of(recording, fitting.plant)
    problem = Problem(space, [Term(engine, data, None, std)], "likelihood")
    low, high = space.low(), space.high()
    is_fault = torch.tensor([name in suspects for name in space.names])
    nominal = space.nominal()
    start_size = nominal + START_SIZE * (high - nominal)
    common_starts = torch.stack([nominal, torch.where(is_fault, start_size, nominal)])
    single_fault_starts = torch.where(torch.diag(is_fault)[is_fault], start_size, nominal)
    starts = torch.cat([common_starts, single_fault_starts])
    refined = levenberg_marquardt(
        lambda theta, lanes: problem.linearise(theta, torch.zeros_like(lanes)), starts, low, high, REFINE
    )
    best = int(torch.nan_to_num(refined.cost, nan=math.inf).argmin())
    theta = refined.theta[best]
    residual = (data.values - engine.readings(theta.unsqueeze(0))[0]) * data.weight / std
    misfit = float(torch.sqrt((residual**2).sum() / data.weight.sum()))
    # A fault whose estimate is its bound is not known exactly: another one may grow with it at the same misfit.
    errors = certainty(refined.curvature[best]).std * max(1.0, misfit)
    levels = torch.stack([_mean_level(fitting, tank.name, data) for tank in fitting.plant.tanks])
    channels = recording.inputs[:, recording.input_columns(fitting.plant.channels())].mean(dim=0)
    faults = []
    for i, parameter in enumerate(space):
        if parameter.name in suspects:
            size, error = float(theta[i]), float(errors[i])
            at_upper_bound = size >= parameter.high  # the true size may be larger; it has no upper limit
            tank_empty = _is_empty(fitting, ParameterName.parse(parameter.name).place, levels)
            state: State = (
                "cannot tell"
                if tank_empty
                else state_of(size - parameter.nominal, error, parameter.high - parameter.nominal)
            )
            error = math.inf if at_upper_bound or tank_empty else error
            flow, _ = fault_flow(fitting.networks[0], space, theta, i, levels, channels)
            faults.append(WindowFault(parameter.name, size, error, state, flow, parameter.unit))
    return Window(float(recording.time[0]), float(recording.time[-1]), tuple(faults), misfit)


def _mean_level(fitting: Fitting, tank: str, data: Readings) -> Tensor:
    """Mean level (m) that the readings show; NaN for a tank without sensor, which must not count as empty."""
    for i, sensor in enumerate(fitting.plant.sensors):
        if sensor.tank == tank:
            mean = (data.values[:, i] * data.weight[:, i]).sum() / data.weight[:, i].sum().clamp(min=1.0)
            return ((mean - sensor.offset) / sensor.gain).clamp(min=0.0)
    return data.values.new_full((), torch.nan)


def _is_empty(fitting: Fitting, place: str, levels: Tensor) -> bool:
    """Whether all tanks whose levels a fault at `place` affects are empty (for a flow component: both ends)."""
    flows = {c.name: {c.source, c.target} for c in fitting.plant.flow_components()}
    tanks = flows.get(place, {place})
    has_water = [
        float(level) >= EMPTY_LEVEL * tank.height
        for tank, level in zip(fitting.plant.tanks, levels, strict=True)
        if tank.name in tanks
    ]
    return bool(has_water) and not any(has_water)


def state_of(size: float, std: float, width: float) -> State:
    """Decide from size, standard error and range `width` (all in one unit) whether a fault is present.

    Present: size > 1.96 std (95 % confidence, two-sided) and size > SIGNIFICANT_SIZE * width. Undecidable: std >=
    INFORMATIVE_STD * width.
    """
    if not std < INFORMATIVE_STD * width:
        return "cannot tell"
    return "present" if size > max(SIGNIFICANT_SIZE * width, 1.96 * std) else "absent"


def stretches_of(windows: Sequence[Window]) -> list[Stretch]:
    """All intervals in which faults are present, ordered by fault, then by time."""
    intervals = []
    for k, first in enumerate(windows[0].faults if windows else ()):
        run: list[Window] = []
        for window in [*windows, None]:
            adjacent = window is not None and (not run or run[-1].start < window.start <= run[-1].stop + 1e-6)
            if window is not None and adjacent and window.faults[k].state == "present":
                run.append(window)
                continue
            if run:
                intervals.append(_merged(first.name, [w.faults[k] for w in run], run[0].start, run[-1].stop))
            run = [window] if window is not None and window.faults[k].state == "present" else []
    return intervals


def _merged(name: str, estimates: Sequence[WindowFault], start: float, stop: float) -> Stretch:
    """Merge the estimates of one fault in consecutive windows.

    The size is the mean m = sum w_i s_i, weighted by flow, with variance sum w_i^2 (std_i^2 + (s_i - m)^2). Windows
    with an infinite standard error are excluded; if they are the majority, the result is the largest size, with
    std = inf.
    """
    flows = [f.flow for f in estimates if f.flow is not None]
    flow = sum(flows) / len(flows) if flows else None
    finite = [f for f in estimates if math.isfinite(f.std)]
    if 2 * len(finite) < len(estimates):
        return Stretch(name, start, stop, max(f.size for f in estimates), math.inf, flow, estimates[0].unit)
    size = torch.tensor([f.size for f in finite], dtype=torch.float64)
    weight = torch.tensor([1.0 if f.flow is None else max(f.flow, 1e-12) for f in finite], dtype=torch.float64)
    weight = weight / weight.sum()
    mean = float((weight * size).sum())
    std_of_window = torch.tensor([f.std for f in finite], dtype=torch.float64)
    std = float(torch.sqrt((weight**2 * (std_of_window**2 + (size - mean) ** 2)).sum()))
    return Stretch(name, start, stop, mean, std, flow, estimates[0].unit)
