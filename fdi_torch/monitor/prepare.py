"""A monitor made ready from a fault-free recording: constants calibrated, noise learnt, threshold set."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.effects import build_network, placements_for
from fdi_torch.estimate.fitting import StartLevels, set_up
from fdi_torch.estimate.refine import RefineSettings, levenberg_marquardt
from fdi_torch.monitor.detection import Chart, make_detector
from fdi_torch.monitor.noise import Noise, learn_noise
from fdi_torch.monitor.observer import Observer
from fdi_torch.monitor.online import Monitor
from fdi_torch.monitor.samples import take
from fdi_torch.monitor.settings import MonitorSettings
from fdi_torch.monitor.stepper import LONGEST_STEP
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording


@dataclass(frozen=True)
class Prepared:
    """The monitor, the values it believes in (those of calibrated constants included), and what was learnt."""

    monitor: Monitor
    believed: Tensor
    noise: Noise
    calibrated: dict[str, float]
    radius: float


def prepare(
    plant: PlantDescription,
    fault_free: Recording,
    faults: Sequence[str] = (),
    calibrate: Sequence[str] = (),
    chart: Chart = "cusum",
    time_between_false_alarms: float = 20000.0,
    settings: MonitorSettings | None = None,
    step: float = LONGEST_STEP,
    seed: int = 0,
    start: StartLevels = "free",
    ranges: Mapping[str, tuple[float, float]] | None = None,
) -> Prepared:
    """A monitor for `faults` (parameters such as 'T1.leak.size'; the usual ones where none is named).

    calibrate: constants fitted to the fault-free recording first, their tolerances as priors. start: what is known of
    the levels then. ranges: of faults whose usual range does not suit. Raises ValueError.
    """
    watched = list(faults) or usual_faults(plant)
    network = build_network(plant, placements_for(watched))
    values = calibration(plant, fault_free, calibrate, step, start) if calibrate else {}
    space = ParameterSpace([network.constants[name] for name in (*watched, *calibrate)])
    for name, (low, high) in (ranges or {}).items():
        space = space.with_changes(name, low=low, high=high)
    believed = space.vector(values)
    samples = take(fault_free, plant)
    noise, seen = learn_noise(network, samples, space, believed, longest_step=step)
    radius = Observer(network, noise.gain, space, believed, step).check_stable(samples, seen)
    sampling = float(torch.diff(samples.time).median())
    generator = torch.Generator().manual_seed(seed)
    detector = make_detector(chart, time_between_false_alarms, sampling, len(plant.sensors), generator)
    monitor = Monitor(network, space, noise, detector, settings, step, watched=len(watched))
    return Prepared(monitor, believed, noise, values, radius)


def calibration(
    plant: PlantDescription, fault_free: Recording, names: Sequence[str], step: float, start: StartLevels = "free"
) -> dict[str, float]:
    """Constants that fit a fault-free recording best, by Levenberg-Marquardt from the nominal ones."""
    fitting = set_up(plant, [fault_free], names, start)
    space = fitting.space
    problem = fitting.problem(step)
    nominal = space.nominal().unsqueeze(0)
    result = levenberg_marquardt(problem.linearise, nominal, space.low(), space.high(), RefineSettings(iterations=100))
    return {name: float(result.theta[0, space.index(name)]) for name in names}


def usual_faults(plant: PlantDescription) -> list[str]:
    """A leak of each tank, plugging of each pipe, loss of each pump's gain and bias of each sensor."""
    leaks = [f"{tank.name}.leak.size" for tank in plant.tanks]
    plugged = [f"{pipe.name}.plugging.size" for pipe in plant.pipes]
    pumps = [f"{pump.name}.pump_gain.factor" for pump in plant.pumps]
    return leaks + plugged + pumps + [f"{sensor.name}.sensor_bias.bias" for sensor in plant.sensors]


def fault_free_part(recording: Recording, start: float, stop: float) -> Recording:
    """The part between two moments (s). Raises ValueError where the recording does not hold it."""
    return replace(recording.window(start, stop), source=f"{recording.source} ({start:g} to {stop:g} s)")
