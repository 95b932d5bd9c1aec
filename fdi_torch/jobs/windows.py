"""Faults window by window: a recording cut into short windows, each fitted on its own, so that a fault that comes and
goes shows when it was there. `estimate.windows` of a run file asks for it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from fdi_torch.config.recordings import LoadedRecording, StartLevel
from fdi_torch.config.run import Run
from fdi_torch.estimate.diagnosis import fault_flow, sample_noise
from fdi_torch.estimate.fitting import Fitting, readings_of
from fdi_torch.estimate.information import certainty
from fdi_torch.estimate.objectives import Problem, Term
from fdi_torch.estimate.refine import RefineSettings, levenberg_marquardt
from fdi_torch.jobs.log_paths import free_path
from fdi_torch.jobs.run_setup import fitting_of, recordings_of, wanted_space
from fdi_torch.jobs.train import log_recordings, origin_of
from fdi_torch.logbook import RunLog
from fdi_torch.recording import Recording
from fdi_torch.simulate.engine import Readings

STEP = 0.5  # of the simulation, s
REFINE = RefineSettings(iterations=40, decrease_tolerance=1e-6)
STARTS = (0.0, 0.3)  # of each fault, between nominal and the end of its range
NOTICED = 0.05  # a size within this of nominal is none, as a share of the range
TOLD = 0.15  # a standard error beyond this share of the range tells nothing
EMPTY = 0.02  # share of its height below which a tank counts as empty: what drains it then, nothing tells
State = Literal["present", "absent", "cannot tell"]


@dataclass(frozen=True)
class WindowFault:
    """size with its standard error (misfit included), and the flow of a leak at the window's mean level, m^3/s."""

    name: str
    size: float
    std: float
    state: State
    flow: float | None


@dataclass(frozen=True)
class Window:
    """start, stop in s; misfit: root mean square residual over the sensors' noise."""

    start: float
    stop: float
    faults: tuple[WindowFault, ...]
    misfit: float


@dataclass(frozen=True)
class Stretch:
    """Consecutive windows in which a fault was present: start, stop in s; size and std of all together (std infinite
    where the size is beyond its range in each); flow (m^3/s) at the mean levels.
    """

    name: str
    start: float
    stop: float
    size: float
    std: float
    flow: float | None


@dataclass(frozen=True)
class WindowsResult:
    windows: tuple[Window, ...]
    stretches: tuple[Stretch, ...]
    log: Path


def windows_of(run: Run, tell: Callable[[float, str], None] = lambda share, text: None) -> WindowsResult:
    """Cuts the recordings of a run file into windows of `estimate.windows` s, and fits the suspects in each.

    A window's own start levels are always free; constants to calibrate have their tolerance as prior in each window.
    """
    length = run.config.estimate.windows
    assert length is not None
    loaded = recordings_of(run)
    space = wanted_space(run)
    suspects = {p.name for p in space if p.name.count(".") == 2}
    folder = Path(run.config.output.folder)
    path = free_path(folder, run.name)
    with RunLog(path, "train", **origin_of(run, loaded)) as log:
        log_recordings(log, loaded, {})
        parts = [(part, noise_of(part.recording, run)) for part in loaded]
        cuts = [(cut, std) for part, std in parts for cut in cut_up(part.recording, length)]
        free: dict[str, StartLevel] = dict.fromkeys((t.name for t in run.plant.tanks), "free")
        found = []
        for k, (cut, std) in enumerate(cuts):
            tell(k / len(cuts), f"window at {float(cut.time[0]):g} s")
            fitting = fitting_of(run, space, [LoadedRecording(cut, free)])
            found.append(window_of(fitting, std, suspects))
        result = WindowsResult(tuple(found), tuple(stretches_of(found)), path)
        log.result({"windows": [_plain(w) for w in found], "stretches": [vars(s) for s in result.stretches]})
    tell(1.0, "done")
    return result


def noise_of(recording: Recording, run: Run) -> Tensor:
    """(C,) sample-to-sample noise of each sensor."""
    readings = readings_of(recording, run.plant)
    return sample_noise(readings.values, readings.weight).clamp(min=1e-6)


def cut_up(recording: Recording, length: float) -> list[Recording]:
    """Windows of `length` s side by side; each shares its last sample with the next one. A short rest is left out."""
    first, last = float(recording.time[0]), float(recording.time[-1])
    count = int((last - first) / length + 1e-9)
    return [recording.window(first + k * length, first + (k + 1) * length) for k in range(count)]


def window_of(fitting: Fitting, std: Tensor, suspects: set[str]) -> Window:
    """The fit of one window, from no fault and from faults of some size."""
    recording, space = fitting.recordings[0], fitting.space
    engine = fitting.engines(STEP)[0]
    data = readings_of(recording, fitting.plant)
    problem = Problem(space, [Term(engine, data, None, std)], "likelihood")
    low, high = space.low(), space.high()
    is_fault = torch.tensor([name in suspects for name in space.names])
    nominal = space.nominal()
    starts = torch.stack([torch.where(is_fault, nominal + s * (high - nominal), nominal) for s in STARTS])
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
            faults.append(WindowFault(parameter.name, size, error, state, flow))
    return Window(float(recording.time[0]), float(recording.time[-1]), tuple(faults), misfit)


def _mean_level(fitting: Fitting, tank: str, data: Readings) -> Tensor:
    """Of a window's readings, m; NaN for a tank that no sensor sees, so that it does not pass for an empty one."""
    for i, sensor in enumerate(fitting.plant.sensors):
        if sensor.tank == tank:
            mean = (data.values[:, i] * data.weight[:, i]).sum() / data.weight[:, i].sum().clamp(min=1.0)
            return ((mean - sensor.offset) / sensor.gain).clamp(min=0.0)
    return data.values.new_full((), torch.nan)


def _empty(fitting: Fitting, place: str, levels: Tensor) -> bool:
    """Whether the tank that a fault drains (a pipe's: both) holds next to nothing."""
    pipes = {p.name: {p.source, p.target} for p in fitting.plant.pipes}
    drained = pipes.get(place, {place})
    return all(
        float(level) < EMPTY * tank.height
        for tank, level in zip(fitting.plant.tanks, levels, strict=True)
        if tank.name in drained
    )


def state_of(size: float, std: float, width: float) -> State:
    """A fault is present where its size stands out of its error at 95 % and is worth noticing."""
    if not std < TOLD * width:
        return "cannot tell"
    return "present" if size > max(NOTICED * width, 1.96 * std) else "absent"


def stretches_of(windows: Sequence[Window]) -> list[Stretch]:
    """Consecutive windows in which a fault is present, as one: by fault, then in time."""
    found = []
    for k, first in enumerate(windows[0].faults if windows else ()):
        row: list[Window] = []
        for window in [*windows, None]:
            goes_on = window is not None and (not row or window.start <= row[-1].stop + 1e-6)
            if window is not None and goes_on and window.faults[k].state == "present":
                row.append(window)
                continue
            if row:
                found.append(_joined(first.name, [w.faults[k] for w in row], row[0].start, row[-1].stop))
            row = [window] if window is not None and window.faults[k].state == "present" else []
    return found


def _joined(name: str, each: Sequence[WindowFault], start: float, stop: float) -> Stretch:
    """The size of the windows together, those in which more water flowed counting for more; its error has their own
    errors and their scatter. Windows whose size is beyond its range have no say in it, unless they are most.
    """
    flows = [f.flow for f in each if f.flow is not None]
    flow = sum(flows) / len(flows) if flows else None
    known = [f for f in each if math.isfinite(f.std)]
    if 2 * len(known) < len(each):
        return Stretch(name, start, stop, max(f.size for f in each), math.inf, flow)
    size = torch.tensor([f.size for f in known], dtype=torch.float64)
    weight = torch.tensor([1.0 if f.flow is None else max(f.flow, 1e-12) for f in known], dtype=torch.float64)
    weight = weight / weight.sum()
    mean = float((weight * size).sum())
    own = torch.tensor([f.std for f in known], dtype=torch.float64)
    std = float(torch.sqrt((weight**2 * (own**2 + (size - mean) ** 2)).sum()))
    return Stretch(name, start, stop, mean, std, flow)


def _plain(window: Window) -> dict[str, object]:
    return {
        "start": window.start,
        "stop": window.stop,
        "misfit": window.misfit,
        **{f.name: {"size": f.size, "std": f.std, "state": f.state} for f in window.faults},
    }
