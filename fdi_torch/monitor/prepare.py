"""A monitor made ready from a fault-free recording: constants calibrated, noise learnt, threshold set."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.effects import build_network, placements_for, without_startup_effects
from fdi_torch.estimate.fitting import StartLevels, set_up
from fdi_torch.estimate.levenberg_marquardt import RefineSettings, levenberg_marquardt
from fdi_torch.monitor.detection import Chart, make_detector
from fdi_torch.monitor.gain import Gain, hand_gain, start_beside_noise, timed_gain
from fdi_torch.monitor.learning import fault_doubts, learnt_words, residual_doubts
from fdi_torch.monitor.monitor import SHAPE, Monitor, faults_of
from fdi_torch.monitor.noise import Noise, learn_noise, noise_of_gain, operating_point
from fdi_torch.monitor.observer import Observer
from fdi_torch.monitor.samples import Samples, take, usual_interval
from fdi_torch.monitor.settings import MonitorSettings
from fdi_torch.monitor.stepper import usual_step
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.network import TankNetwork
from fdi_torch.recording import Recording


@dataclass(frozen=True)
class Prepared:
    """The monitor, the values it believes in (those of calibrated constants included), and what was learnt. learnt: how
    sure that is, in words. doubts: what speaks against it.
    """

    monitor: Monitor
    believed: Tensor
    noise: Noise
    calibrated: dict[str, float]
    radius: float
    doubts: tuple[str, ...] = ()
    learnt: str = ""


@dataclass(frozen=True)
class GainWish:
    """An observer's gain where it is not to follow from the noise: for a time constant in s, or by hand (tanks x
    sensors, per sample: m per unit of the reading).
    """

    time_constant: float | None = None
    by_hand: tuple[tuple[float, ...], ...] = ()

    def __post_init__(self) -> None:
        if (self.time_constant is None) == (not self.by_hand):
            raise ValueError("expected either a time constant or a gain by hand, got both or none; give one")


def prepare(
    plant: PlantDescription,
    fault_free: Recording,
    faults: Sequence[str] = (),
    calibrate: Sequence[str] = (),
    chart: Chart = "cusum",
    time_between_false_alarms: float = 20000.0,
    settings: MonitorSettings | None = None,
    step: float | None = None,
    seed: int = 0,
    start: StartLevels = "free",
    ranges: Mapping[str, tuple[float, float]] | None = None,
    gain: GainWish | None = None,
) -> Prepared:
    """A monitor for `faults` (parameters such as 'T1.leak.size'; the usual ones where none is named).

    calibrate: constants fitted to the fault-free recording first, their tolerances as priors. start: what is known of
    the levels then. step: longest of the integration, s. ranges: of faults whose usual range does not suit.
    Raises ValueError.
    """
    # No step is longer than the usual interval between samples, which also says how sharply roots and rims are drawn.
    step = min(usual_step(plant) if step is None else step, 1.25 * usual_interval(fault_free.time))
    watched = with_shapes(list(faults) or usual_faults(plant), plant)
    network = build_network(plant, placements_for(watched))
    running = without_startup_effects(plant, fault_free.ran)  # the fault-free part may be from the midst of the run
    learning = build_network(running, placements_for([*watched, *calibrate]))
    values = calibration(running, fault_free, calibrate, step, start) if calibrate else {}
    space = ParameterSpace([network.constants[name] for name in (*watched, *calibrate)])
    for name in watched:
        if name.endswith(".phase"):  # once round in either direction, so that no fit ends at a seam
            space = space.with_changes(name, low=-2.0 * math.pi, high=2.0 * math.pi)
    for name, (low, high) in (ranges or {}).items():
        space = space.with_changes(name, low=low, high=high)
    believed = space.vector(values)
    samples = take(fault_free, plant)
    if gain is None:
        noise, seen = learn_noise(learning, samples, space, believed, longest_step=step)
        radius = Observer(learning, noise.gain, space, believed, step).check_stable(samples)
    else:
        wished = _wished(learning, samples, space, believed, step, gain)
        observer = Observer(learning, wished, space, believed, step)
        radius = observer.check_stable(samples)
        noise, seen = noise_of_gain(learning, wished, samples, space, believed, step)
    sampling = float(torch.diff(samples.time).median())
    generator = torch.Generator().manual_seed(seed)
    every = time_between_false_alarms
    detector = make_detector(chart, every, sampling, len(plant.sensors), generator, learnt=noise.whitening)
    monitor = Monitor(network, space, noise, detector, settings, step, watched=len(watched))
    doubts = (
        *residual_doubts(plant, noise, detector, seen, every),
        *fault_doubts(learning, space, samples, believed, step, faults_of(watched)),
    )
    learnt = learnt_words(plant, noise, detector, every, sampling)
    return Prepared(monitor, believed, noise, values, radius, doubts, learnt)


def _wished(
    network: TankNetwork, samples: Samples, space: ParameterSpace, believed: Tensor, step: float, wish: GainWish
) -> Gain:
    if wish.by_hand:
        return hand_gain(torch.tensor(wish.by_hand, dtype=network.nominal.dtype))
    linear = operating_point(network, samples, space, believed, step)
    unit = torch.linalg.vector_norm(linear.output, dim=-1)
    span = float(torch.diff(samples.time).median())
    assert wish.time_constant is not None
    return timed_gain(linear, span, wish.time_constant, unit, start_beside_noise(network.description, unit))


def with_shapes(faults: Sequence[str], plant: PlantDescription) -> list[str]:
    """The faults, and after each oscillation its period and phase."""
    known = build_network(plant, placements_for(faults)).constants
    wider = []
    for name in faults:
        effect = name.rpartition(".")[0]
        wider += [name, *(f"{effect}.{s}" for s in SHAPE if f"{effect}.{s}" in known and f"{effect}.{s}" not in faults)]
    return wider


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
    """A leak of each tank, plugging of each pipe, gain and offset of each pump, and bias, gain and freezing of each
    sensor.
    """
    leaks = [f"{tank.name}.leak.size" for tank in plant.tanks]
    plugged = [f"{pipe.name}.plugging.size" for pipe in plant.pipes]
    pumps = [f"{pump.name}.{fault}" for fault in ("pump_gain.factor", "pump_offset.offset") for pump in plant.pumps]
    wrong = ("sensor_bias.bias", "sensor_gain.factor", "sensor_stuck.size")
    return leaks + plugged + pumps + [f"{sensor.name}.{fault}" for fault in wrong for sensor in plant.sensors]


def fault_free_part(recording: Recording, start: float, stop: float) -> Recording:
    """The part between two moments (s). Raises ValueError where the recording does not hold it."""
    return replace(recording.window(start, stop), source=f"{recording.source} ({start:g} to {stop:g} s)")
