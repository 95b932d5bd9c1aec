"""Checks of the fault-free part: signs of a fault in it, and how accurate the learnt false-alarm rate is."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from fdi_torch.monitor.detection import DRIFT, VERY_LONG, Detector
from fdi_torch.monitor.events import Explanation, percent_text, size_of
from fdi_torch.monitor.hypothesis import Fault
from fdi_torch.monitor.isolation import isolate
from fdi_torch.monitor.law_errors import ConstantErrors
from fdi_torch.monitor.noise_model import NoiseModel, operating_point
from fdi_torch.monitor.observer import Observation
from fdi_torch.monitor.observer_bank import ObserverBank, ObserverWindow
from fdi_torch.monitor.observer_gain import kalman_gain, start_uncertainty
from fdi_torch.monitor.samples import Samples
from fdi_torch.monitor.whitening import Whitening
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.network import TankNetwork
from fdi_torch.quantities import quantity_text

# Process noise over reading noise that counts as no process noise.
NO_PROCESS_NOISE = 1e-3
# Posterior probability from which a fault in the fault-free part is reported.
CONVINCING = 0.99
# Offset of the white residual that is reported, in standard deviations: half the drift that a CUSUM allows.
OFFSET = 0.5 * DRIFT
SIGNIFICANT = 4.0  # standard errors of an offset or a fault size
RATE_FACTOR = 2.0  # desired accuracy of the false-alarm rate, as a factor
QUESTION = "does the recording start faulty? Name another fault_free part"


def residual_warnings(plant: PlantDescription, noise: NoiseModel, detector: Detector, seen: Observation) -> list[str]:
    """Warnings about the residual: too many alarms in the fault-free part, or a significant constant offset."""
    warnings = []
    alarms = detector.alarms(noise.whitening(seen.steady_residual)).nonzero().flatten()
    seconds = noise.whitening.samples * detector.design.interval
    if len(alarms) > detector.design.count_quantile(seconds, 0.99):
        first = f"the first at {float(seen.time[alarms[0]]):g} s"
        warnings.append(f"the part taken for fault-free raises {len(alarms)} alarms itself, {first}: {QUESTION}")
    white, smallest = noise.whitening, max(OFFSET, SIGNIFICANT * noise.whitening.samples**-0.5)
    for sensor, mean, offset in zip(plant.sensors, white.mean.tolist(), white.offset.tolist(), strict=True):
        if abs(offset) > smallest:
            off = f"{sensor.name} lies {quantity_text(mean, sensor.unit, 3, sensor.column)} off the observer throughout"
            warnings.append(f"in the fault-free part {off}; this is taken for the plant's own: calibrate a constant")
    return warnings


def fault_warnings(
    network: TankNetwork,
    space: ParameterSpace,
    samples: Samples,
    believed: Tensor,
    step: float,
    faults: Sequence[Fault],
    constants: ConstantErrors,
) -> list[str]:
    """Warning about a single fault in the fault-free part that explains the readings down to their noise.

    The learnt noise model would attribute the effect of such a fault to process noise. This check therefore assumes no
    process noise, and takes the measurement noise from second differences.
    """
    linear = operating_point(network, samples, space, believed, step)
    std = noise_std_from_differences(samples.readings)
    if not bool((std > 0.0).all()):
        return []
    start = start_uncertainty(network.description, std)
    gain = kalman_gain(linear, NO_PROCESS_NOISE * float(std.min()) * torch.ones_like(start), std, start)
    zeros, count = torch.zeros_like(std), len(samples)
    whitening = Whitening(zeros, std.new_zeros(0, len(std), len(std)), torch.diag(1.0 / std), count, zeros)
    observer = ObserverBank(network, space, gain, whitening, step, constants)
    steady = [fault for fault in faults if not fault.shape]
    first, _ = observer.first_state(samples, believed)
    best = isolate(observer, ObserverWindow(samples, first, 1), believed, steady, deepest=1)[0]
    columns = best.hypothesis.columns
    if not best.fits or not columns or best.probability < CONVINCING or best.onset_std == 0.0:
        return []
    p, size, error = space.parameters[columns[0]], float(best.value[columns[0]]), float(best.std[columns[0]])
    if abs(size - p.nominal) < SIGNIFICANT * error:
        return []
    fault = Explanation(best.probability, (size_of(p, size, error),)).text
    since = f"since {best.onset:.0f} s, probability {percent_text(best.probability)}"
    return [f"{fault} {since}, explains the part taken for fault-free: {QUESTION}"]


def learning_times(noise: NoiseModel, detector: Detector) -> tuple[float, float]:
    """How long the noise was learnt, and how long would determine the false-alarm rate within a factor of RATE_FACTOR
    (95 %), s.
    """
    seconds = noise.whitening.samples * detector.design.interval
    return seconds, seconds * detector.design.learning_factor(RATE_FACTOR)


def false_alarm_rate_text(noise: NoiseModel, detector: Detector, every: float) -> str:
    """Text: the expected time between false alarms, the 95 % interval of their number in it, how long a fault-free part
    would determine their rate within a factor of RATE_FACTOR (95 %), and how much a shorter one raises the threshold.

    The text gives no interval of the rate itself, because the mean rate may lie outside of it: a small share of the
    posterior of the noise may dominate the mean.
    """
    seconds, needed = learning_times(noise, detector)
    fewest, most = (detector.design.count_quantile(every, p) for p in (0.025, 0.975))
    text = (
        f"the noise is learnt from {quantity_text(seconds, 's')} ({quantity_text(needed, 's')} needed); expect one "
        f"false alarm in {quantity_text(every, 's', 5)} ({fewest} to {most} with a probability of 95 %)"
    )
    if noise.whitening.flows is None:
        text += ", if no random flow is slow: to model these, install a C++ compiler or the extra fdi_torch[compiler]"
    if needed <= seconds:
        return text
    higher = 100.0 * (detector.threshold / detector.design.longer(VERY_LONG).threshold - 1.0)
    return f"{text}; the fault-free part is short, so that the threshold is {higher:.2g} % higher: lengthen fault_free"


def noise_std_from_differences(readings: Tensor) -> Tensor:
    """Standard deviation (sensors,) of the noise of readings (S, sensors), from their second differences.

    The second difference of white noise with variance 1 has variance 6; that of a slow signal is negligible. NaN
    readings are ignored.
    """
    second_difference = readings[2:] - 2.0 * readings[1:-1] + readings[:-2]
    return second_difference.square().nanmean(dim=0).div(6.0).sqrt()
