"""What was learnt from the part taken for fault-free: how sure it is, and what speaks against it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from fdi_torch.monitor.change import ChangedObserver, Window
from fdi_torch.monitor.detection import DRIFT, Detector, rate_error
from fdi_torch.monitor.events import amount, percent
from fdi_torch.monitor.gain import kalman_gain, start_uncertainty
from fdi_torch.monitor.hypothesis import Fault
from fdi_torch.monitor.isolation import isolate
from fdi_torch.monitor.noise import Noise, operating_point
from fdi_torch.monitor.observer import Observation
from fdi_torch.monitor.samples import Samples
from fdi_torch.monitor.whitening import Whitening
from fdi_torch.parameters import ParameterSpace, display_unit
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.network import TankNetwork

# Levels that wander by so little, as a share of a reading's noise, do not wander.
STILL = 1e-3
# How likely a fault within it must be before it is asked about.
CONVINCING = 0.99
# An offset of the white residual is told from here on, in its standard deviations: half the drift that a CUSUM allows.
OFFSET = 0.5 * DRIFT
SURELY = 4.0  # standard errors of it
MANY = 30.0  # of which a Poisson number is nearly normal
WITHIN = 2.0  # factor of the rate of false alarms that is good enough
QUESTION = "does the recording start faulty? Name another fault_free part"


def _most_by_chance(detector: Detector, noise: Noise, channels: int, every: float, sampling: float) -> int:
    """How many alarms its own part raises at most, with 99 %: a Poisson number at the highest rate that is likely."""
    error = rate_error(detector.chart, every / sampling, channels, DRIFT, noise.whitening)
    expected = noise.whitening.samples * sampling / every * math.exp(1.96 * error)
    if expected > MANY:
        return math.ceil(expected + 2.33 * math.sqrt(expected))
    count, term = 0, math.exp(-expected)
    held = term
    while held < 0.99:
        count += 1
        term *= expected / count
        held += term
    return count


def residual_doubts(
    plant: PlantDescription, noise: Noise, detector: Detector, seen: Observation, every: float
) -> list[str]:
    """Alarms within it, and readings that lie off the observer throughout, by more than chance and enough to matter."""
    doubts = []
    alarms = detector.alarms(noise.whitening(seen.steady_residual)).nonzero().flatten()
    if len(alarms) > _most_by_chance(detector, noise, len(plant.sensors), every, float(torch.diff(seen.time).median())):
        first = f"the first at {float(seen.time[alarms[0]]):g} s"
        doubts.append(f"the part taken for fault-free raises {len(alarms)} alarms itself, {first}: {QUESTION}")
    white, least = noise.whitening, max(OFFSET, SURELY * noise.whitening.samples**-0.5)
    for sensor, mean, offset in zip(plant.sensors, white.mean.tolist(), white.offset.tolist(), strict=True):
        if abs(offset) > least:
            unit, scale = display_unit(sensor.unit)
            off = f"{sensor.name} lies {scale * mean:.3g} {unit} off the observer throughout"
            doubts.append(f"in the fault-free part {off}; this is taken for the plant's own: calibrate a constant")
    return doubts


def fault_doubts(
    network: TankNetwork,
    space: ParameterSpace,
    samples: Samples,
    believed: Tensor,
    step: float,
    faults: Sequence[Fault],
) -> list[str]:
    """A single fault within it that leaves nothing but the readings' own noise.

    Noise is learnt as levels that wander where a fault moves them; here they stand still, and the noise of readings is
    what changes from one sample to the next.
    """
    linear = operating_point(network, samples, space, believed, step)
    std = sample_spread(samples.readings)
    if not bool((std > 0.0).all()):
        return []
    start = start_uncertainty(network.description, std)
    gain = kalman_gain(linear, STILL * float(std.min()) * torch.ones_like(start), std, start)
    none, count = torch.zeros_like(std), len(samples)
    still = Whitening(none, std.new_zeros(0, len(std), len(std)), torch.diag(1.0 / std), count, none)
    observer = ChangedObserver(network, space, gain, still, step)
    steady = [fault for fault in faults if not fault.shape]
    first, _ = observer.first_state(samples, believed)
    best = isolate(observer, Window(samples, first, 1), believed, steady, incipient=False, deepest=1)[0]
    columns = best.hypothesis.columns
    if not best.fits or not columns or best.mass < CONVINCING or best.onset_std == 0.0:
        return []
    p, size, error = space.parameters[columns[0]], float(best.value[columns[0]]), float(best.std[columns[0]])
    if abs(size - p.nominal) < SURELY * error:
        return []
    told = f"{amount(p, size, error)} since {best.onset:.0f} s, probability {percent(best.mass)}"
    return [f"{told}, explains the part taken for fault-free: {QUESTION}"]


def learnt_words(plant: PlantDescription, noise: Noise, detector: Detector, every: float, sampling: float) -> str:
    """How sure the time between false alarms is, and how much fault-free time a surer one takes.

    The logarithm of their rate has the standard error e, which falls with the square root of the time: so that the
    rate lies within a factor of WITHIN (95 %), the part must be (1.96 e / ln WITHIN)^2 times as long.
    """
    error = rate_error(detector.chart, every / sampling, len(plant.sensors), DRIFT, noise.whitening)
    seconds = noise.whitening.samples * sampling
    needed = seconds * (1.96 * error / math.log(WITHIN)) ** 2
    told = (
        f"learnt from {seconds:g} s: one false alarm in {every:g} s, to within a factor of {math.exp(1.96 * error):.2g}"
    )
    if needed <= seconds:
        return told
    return f"{told}; a factor of {WITHIN:g} takes {needed:.0f} s without a fault: lengthen fault_free"


def sample_spread(readings: Tensor) -> Tensor:
    """Standard deviation (sensors,) of the noise of readings (S, sensors), from their second differences.

    White noise has a second difference of variance 6; what moves slowly has none. NaN readings are left out.
    """
    bend = readings[2:] - 2.0 * readings[1:-1] + readings[:-2]
    return bend.square().nanmean(dim=0).div(6.0).sqrt()
