"""Checks of the fault-free part: signs of a fault in it, and how accurate the learnt false-alarm rate is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from torch import Tensor

from fdi_torch.amounts import percent_text
from fdi_torch.estimate.evidence import posterior
from fdi_torch.monitor.detection import DRIFT, VERY_LONG, Detector
from fdi_torch.monitor.events import Explanation, size_of
from fdi_torch.monitor.flow_noise_estimate import with_usual_flows
from fdi_torch.monitor.hypothesis import Fault, HypothesisFit
from fdi_torch.monitor.hypothesis_fit import changes_of
from fdi_torch.monitor.isolation import SMALLEST_PROBABILITY, isolate
from fdi_torch.monitor.noise_model import NoiseModel
from fdi_torch.monitor.observer import Observation
from fdi_torch.monitor.observer_bank import ObserverBank, ObserverWindow
from fdi_torch.monitor.samples import Samples
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.network import TankNetwork
from fdi_torch.quantities import quantity_text

# Posterior probability from which a fault in the fault-free part is reported. Without a fault, posterior odds of 99 are
# rarer than 1 in 99 times the prior odds of a fault.
CONVINCING = 0.99
# Offset of the white residual that is reported, in standard deviations: half the drift that a CUSUM allows.
OFFSET = 0.5 * DRIFT
SIGNIFICANT = 4.0  # standard errors of an offset
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
    noise: NoiseModel,
) -> list[str]:
    """Warning about a single sudden fault in the fault-free part, if there is one with a probability of CONVINCING.

    The random flows were learnt as if there were no fault, and hold its effect. Faults are therefore searched for
    beside the usual flows, and again beside those that are most likely under the likeliest fault. Each plausible
    explanation, no fault included, then has the evidence at the flows that are most likely under it.
    """
    sudden = [fault for fault in faults if not fault.shape]
    if not sudden:
        return []
    whitening = noise.whitening
    if whitening.flows is not None:
        whitening = whitening.with_flows(with_usual_flows(whitening.flows))
    observer = ObserverBank(network, space, noise.gain, whitening, step, noise.constants)
    window = ObserverWindow(samples, observer.first_state(samples, believed)[0], 1)
    first = isolate(observer, window, believed, sudden, deepest=1)
    likeliest = next(f for f in first if f.hypothesis.columns)
    observer = observer.learning_from(window, believed, changes_of([likeliest]))[0]
    fits = isolate(observer, window, believed, sudden, deepest=1, earlier=first)
    excess = min(fits, key=lambda f: f.misfit).misfit_ratio  # by which `isolate` divided the misfits
    fits = [f for f in fits if f.probability > SMALLEST_PROBABILITY or not f.hypothesis.columns]
    likelihoods = [observer.learning_from(window, believed, changes_of([f]))[1] for f in fits]
    evidence = [f.evidence + f.misfit / excess + likelihood for f, likelihood in zip(fits, likelihoods, strict=True)]
    ranked = [replace(f, probability=p) for f, p in zip(fits, posterior(evidence), strict=True)]
    if sum(f.probability for f in ranked if f.hypothesis.columns) < CONVINCING:
        return []
    return [_question(observer, sorted(ranked, key=lambda f: -f.probability))]


def _question(observer: ObserverBank, ranked: Sequence[HypothesisFit]) -> str:
    """The likeliest fault, and the question."""
    likeliest = next(f for f in ranked if f.hypothesis.columns)
    [column] = likeliest.hypothesis.columns
    size = size_of(observer.space.parameters[column], float(likeliest.value[column]), float(likeliest.std[column]))
    fault = Explanation(likeliest.probability, (size,)).text
    since = f"since {likeliest.onset:.0f} s, probability {percent_text(likeliest.probability)}"
    return f"{fault} {since}, explains the part taken for fault-free: {QUESTION}"


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
        f"the noise is learnt from {quantity_text(seconds, 's')} (to know the rate of false alarms within a "
        f"factor of {RATE_FACTOR:g} takes {quantity_text(needed, 's')}); expect one false alarm in "
        f"{quantity_text(every, 's', 5)} ({fewest} to {most} with a probability of 95 %)"
    )
    if noise.whitening.flows is None:
        text += ", if no random flow is slow: to model these, install a C++ compiler or the extra fdi_torch[compiler]"
    if needed <= seconds:
        return text
    higher = 100.0 * (detector.threshold / detector.design.longer(VERY_LONG).threshold - 1.0)
    return f"{text}; the fault-free part is short, so that the threshold is {higher:.2g} % higher: lengthen fault_free"
