"""Set-up of a monitor from a fault-free recording: calibrate constants, identify the noise, design the detector."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from fdi_torch.effects import build_network, placements_for, without_startup_effects
from fdi_torch.effects.usual_faults import usual_faults
from fdi_torch.estimate.fitting import StartLevels, set_up
from fdi_torch.estimate.levenberg_marquardt import RefineSettings, levenberg_marquardt
from fdi_torch.monitor.detection import Chart, make_detector
from fdi_torch.monitor.fault_free_checks import false_alarm_rate_text, fault_warnings, residual_warnings
from fdi_torch.monitor.flow_filter import FlowFilter
from fdi_torch.monitor.flow_noise_estimate import by_initial_levels, free_residual
from fdi_torch.monitor.hypothesis import SHAPE, faults_of
from fdi_torch.monitor.law_errors import ConstantErrors
from fdi_torch.monitor.monitor import Monitor, ResidualTrace
from fdi_torch.monitor.monitor_settings import MonitorSettings
from fdi_torch.monitor.noise_model import effects_of_constants, learn_beside_errors
from fdi_torch.monitor.observer import Observer
from fdi_torch.monitor.samples import mean_interval, samples_of_recording, usual_interval
from fdi_torch.monitor.stepper import usual_step
from fdi_torch.monitor.whitening import FEWEST_SAMPLES
from fdi_torch.parameters import ParameterName, ParameterSpace
from fdi_torch.plant.description import PlantDescription, uncertain_constants
from fdi_torch.recording import Recording
from fdi_torch.simulate.step_length import commensurate_step

CHANCE = 0.01
"""Probability of an alarm in a recording that the plant explains throughout; as that of the warning about alarms in a
fault-free part (`fault_free_checks.residual_warnings`)."""
BATCH = 32  # samples processed before the alarms are looked at: a monitor would go on to explain them, which takes long


@dataclass(frozen=True)
class PreparedMonitor:
    """A monitor ready to start.

    believed: parameter values for the observer, including calibrated constants, and calibrated: these by name.
    warnings: signs of a fault in the fault-free part. false_alarm_text: accuracy of the time between false alarms.
    """

    monitor: Monitor
    believed: Tensor
    calibrated: dict[str, float]
    warnings: tuple[str, ...] = ()
    false_alarm_text: str = ""


def prepare_monitor(
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
) -> PreparedMonitor:
    """A monitor for `faults` (parameters such as 'T1.leak.size'; the usual ones by default). The usual ones that are
    not among them are causes that are not on the list.

    calibrate: constants that are first fitted to the fault-free recording, with their tolerances as priors. All others
    with a tolerance are estimated beside the random flows. start: knowledge of the initial levels. step: longest
    integration step, s; by default `usual_step`, or the fraction of the sampling interval next to it. ranges: replace
    the usual ranges of faults. Raises ValueError.
    """
    # The step is at most the usual sampling interval, because it also sets how sharply square roots and rims are
    # resolved.
    interval = usual_interval(fault_free.time)
    step = min(commensurate_step(usual_step(plant), interval) if step is None else step, 1.25 * interval)
    watched = with_shapes(list(faults) or usual_faults(plant), plant)
    unlisted = [name for name in usual_faults(plant) if name not in watched]
    network = build_network(plant, placements_for([*watched, *unlisted]))
    running = without_startup_effects(plant, fault_free.ran)  # the fault-free part need not be the start of the run
    learning = build_network(running, placements_for([*watched, *calibrate, *unlisted]))
    uncertain = uncertain_constants(running, {*watched, *calibrate, *unlisted})
    values = calibration(running, fault_free, calibrate, step, start) if calibrate else {}
    space = ParameterSpace([network.constants[name] for name in (*watched, *calibrate, *uncertain, *unlisted)])
    for name in watched:
        if ParameterName.parse(name).field == "phase":  # a full turn either way, so that no fit stops at +-pi
            space = space.with_changes(name, low=-2.0 * math.pi, high=2.0 * math.pi)
    for name, (low, high) in (ranges or {}).items():
        for limit in space[name].extremes:
            if low < limit < high:  # nothing changes beyond it, and a fit would stop at the kink there
                raise ValueError(
                    f"ranges: {name}: expected a range that ends at {limit:g}, a physical limit, "
                    f"got {low:g} to {high:g}; leave out what lies beyond it"
                )
        space = space.with_changes(name, low=low, high=high)
    believed = space.vector(values)
    samples = samples_of_recording(fault_free, plant)
    calibrated, others = ([space.index(name) for name in names] for names in (calibrate, uncertain))
    noise, seen, believed, expected = learn_beside_errors(learning, samples, space, believed, others, step)
    observed = partial(Observer, learning, noise.gain, longest_step=step)
    effects = effects_of_constants(observed, samples, space, believed, calibrated)
    constants = constant_errors([*calibrated, *others], effects, noise.whitening.flows, expected)
    noise = replace(noise, constants=constants)
    sampling = mean_interval(samples.time)
    generator = torch.Generator().manual_seed(seed)
    every = time_between_false_alarms
    detector = make_detector(chart, every, sampling, len(plant.sensors), generator, learnt=noise.whitening)
    monitor = Monitor(network, space, noise, detector, settings, step, len(watched), len(unlisted))
    warnings = (
        *residual_warnings(plant, noise, detector, seen),
        *fault_warnings(learning, space, samples, believed, step, faults_of(watched), noise),
    )
    text = false_alarm_rate_text(noise, detector, every)
    return PreparedMonitor(monitor, believed, values, warnings, text)


def constant_errors(
    columns: Sequence[int], effects: Tensor, flows: FlowFilter | None, expected: Tensor
) -> ConstantErrors:
    """What is not known about constants in columns of a space: of the first ones, which are calibrated, what least
    squares on the fault-free part left unknown (nothing without a flow filter); of the others, their tolerances.

    effects (P, S, sensors): of the P calibrated ones on the residuals of the fault-free part, per standard deviation of
    their priors. expected: means of the priors of the others, in these standard deviations from the values in use.
    """
    covariance, count = torch.eye(len(columns), dtype=torch.float64), len(effects)
    covariance[:count] = 0.0
    if count and flows is not None:
        covariance[:count, :count] = covariance_of_least_squares(flows, effects)
    return ConstantErrors(tuple(columns), covariance, count, torch.cat([expected.new_zeros(count), expected]))


def covariance_of_least_squares(flows: FlowFilter, effects: Tensor) -> Tensor:
    """Covariance (P, P) of the errors of P constants that were estimated by least squares in a free run.

    effects (P, S, sensors): of the constants, per standard deviation of their priors, on the residuals of the observer.
    The residuals of a free run are y = X x + G g + n, with initial levels x and errors g, each N(0, 1) in units of its
    prior, and the effect n of random flows and measurement noise. The error of an estimate E y is
    (E G - 1) g + E (X x + n).

    The most likely estimate beside random flows would have a smaller error, but only if the model is exact: it weighs
    the moments at which inputs step most, where each delay of an actuator counts as an error of its gain.
    """
    by_constants, tanks = free_residual(flows.linear, flows.observer, effects), len(flows.start_std)
    weight = torch.isfinite(by_constants[0]) / flows.innovation_std
    by_levels = by_initial_levels(flows.linear, len(weight))[..., :tanks] * flows.start_std
    both = torch.cat([by_levels, by_constants.nan_to_num().permute(1, 2, 0)], -1) * weight.unsqueeze(-1)
    x, eye = both.flatten(0, 1), torch.eye(both.shape[-1], dtype=both.dtype)
    estimate = torch.linalg.solve(x.mT @ x + eye, x.mT)[tanks:]
    error = estimate @ x - eye[tanks:]
    return error @ error.mT + flows.covariance_of_sums(estimate.reshape(len(effects), *weight.shape) * weight)


def with_shapes(faults: Sequence[str], plant: PlantDescription) -> list[str]:
    """The faults, each oscillation followed by its period and phase."""
    constants = build_network(plant, placements_for(faults)).constants
    names = []
    for name in faults:
        siblings = (str(ParameterName.parse(name).sibling(field)) for field in SHAPE)
        names += [name, *(s for s in siblings if s in constants and s not in faults)]
    return names


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


def fault_free_part(recording: Recording, start: float, stop: float) -> Recording:
    """The part between two moments (s). Raises ValueError if the recording, or a sensor, has too few samples there."""
    part = replace(recording.window(start, stop), source=f"{recording.source} ({start:g} to {stop:g} s)")
    first = float(part.time[0])
    for name, count in zip(part.output_names, part.mask.sum(dim=0).tolist(), strict=True):
        if count < FEWEST_SAMPLES:
            raise ValueError(
                f"{part.source}: {name}: expected at least {FEWEST_SAMPLES} readings to learn the noise from, "
                f"got {count} in {len(part)} samples, the first at {first:g} s; lengthen fault_free, or correct the "
                f"column or tag of {name}"
            )
    return part


def explained_until(plant: PlantDescription, recording: Recording, learnt: float) -> float:
    """How long a plant explains a recording: until when a monitor that learns up to `learnt`, s, raises no alarm, s.

    The time before an alarm is that at which the detector's statistic last was as small as usual, its median before:
    later the deviation that causes the alarm has begun. Raises ValueError if the monitor cannot learn.
    """
    first, last = float(recording.time[0]), float(recording.time[-1])
    prepared = prepare_monitor(
        plant, fault_free_part(recording, first, learnt), time_between_false_alarms=(last - first) / CHANCE
    )
    samples, traces = samples_of_recording(recording, plant), list[ResidualTrace]()
    state = prepared.monitor.start(samples.segment(0, 1), prepared.believed, learning_until=learnt)
    for k in range(1, len(samples), BATCH):
        state, events = prepared.monitor.advance(state, samples.segment(k, min(k + BATCH, len(samples))), traces.append)
        alarm = next((event.time for event in events if event.kind == "alarm"), None)
        if alarm is not None:
            time, statistic = (torch.cat(each) for each in zip(*((t.time, t.statistic) for t in traces), strict=True))
            before = (time > learnt) & (time < alarm)
            usual = time[before & (statistic <= statistic[before].nanmedian())]
            return float(usual[-1]) if len(usual) else learnt
    return last
