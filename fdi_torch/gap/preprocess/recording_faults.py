"""Faults of a recording, as opposed to faults of the plant: each is a hypothesis that can be tested.

    wrong unit        y = 10^k y'           k = -3 ... 3, of one sensor or one input
    swapped channels  y_a = y'_b, y_b = y'_a    two sensors, or two inputs, of one unit
    clock offset      y(t) = y'(t + delay)  all sensors, or one of them, against the inputs
    unrelated sensor  y = mean + scatter    the readings do not depend on the level

y' are the recorded and y the true readings. A hypothesis undoes its fault in the recording; only the clock offset has a
parameter to fit. Its weight is the log-likelihood of the corrected recording (`blockwise_likelihood.py`) plus the log
prior. `recording_fault_decision.py` compares the weights with those of the recording as it is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import torch
from torch import Tensor

from fdi_torch.gap.dataset import interpolate
from fdi_torch.gap.preprocess.blockwise_likelihood import (
    BlockwiseFit,
    blocked_recording,
    blockwise_fit,
    first_order_log_likelihood,
    noise_of,
    thinned,
)
from fdi_torch.plant.description import PlantDescription, Sensor
from fdi_torch.recording import Recording

DECADES = (-3, -2, -1, 1, 2, 3)
"""Powers of ten by which a unit can be wrong; millimetres instead of metres at most."""
MAX_DELAY = 0.25
"""Largest clock offset, as a share of the recording."""
DELAY_CORRECTIONS = 4
"""Gauss-Newton steps for the clock offset."""
DELAY_TOLERANCE = 0.05
"""Share of a sampling interval; a smaller correction of the clock offset ends the iteration."""
PRELIMINARY_EVALUATIONS = 3
"""Evaluations of a preliminary fit, which selects the power of ten of an input that gets a full fit. A budget of
computing."""
MOST_EXPLAINED = 0.8
"""If a sensor fault explains this share of the lacking log-likelihood, faults of inputs are not tested. A budget of
computing: each of them needs a fit of its own, and another fault that explains as much changes the sentence, not the
refusal."""
MOST_INPUTS = 8
"""Inputs of equal flow into one tank, of which one with a wrong unit still shows in the mean level."""


@dataclass(frozen=True)
class RecordingFault:
    """A fault of the recording: its channels, and a sentence that says what to do.

    silent: the one channel is a sensor whose readings do not depend on its level. physical: a delay of the sensor
    itself would look the same, so that the gap diagnosis must accept the recording.
    """

    channels: tuple[str, ...]
    text: str
    silent: bool = False
    physical: bool = False


@dataclass(frozen=True)
class WeightedFault:
    """A fault with its log posterior weight, not normalised."""

    fault: RecordingFault
    log_weight: float


@dataclass(frozen=True)
class FaultHypotheses:
    """All faults that a recording may have. as_is: fit of the recording without a correction. constant: columns of
    sensors that never move. prior: log prior probability of each single fault.

    A hypothesis is fitted only if its first-order gain in log-likelihood exceeds the cost of its prior.
    """

    plant: PlantDescription
    recording: Recording
    as_is: BlockwiseFit
    constant: tuple[str, ...]
    prior: float

    def each(self) -> Iterator[WeightedFault]:
        """Yield all fitted hypotheses.

        Faults of inputs come last because each needs a fit of its own; they are skipped if a fault of a sensor already
        explains most of the misfit.
        """
        lacking, best = self.as_is.most - self.as_is.log_likelihood, -math.inf
        for make in (self._units, self._swapped, self._clocks, self._silent, self._of_inputs):
            if make == self._of_inputs and best > self.as_is.log_likelihood + MOST_EXPLAINED * lacking:
                return
            for fault, weight in make():
                best = max(best, weight)
                yield WeightedFault(fault, self.prior + weight)

    def _of_inputs(self) -> Iterator[tuple[RecordingFault, float]]:
        yield from self._units_of_inputs()
        yield from self._swapped_inputs()

    def _fit(self, corrected: Recording, preliminary: bool = False) -> BlockwiseFit:
        """The plant fitted to a corrected recording; preliminary: with few evaluations only."""
        blocked = blocked_recording(self.plant, thinned(corrected), noise_of(self.plant, corrected))
        if preliminary:
            return blockwise_fit(blocked, base=self.as_is, cap=PRELIMINARY_EVALUATIONS, rounds=1)
        return blockwise_fit(blocked, base=self.as_is)

    def _weight(self, corrected: Recording) -> float:
        return self._fit(corrected).log_likelihood

    def _column(self, sensor: int) -> int:
        return self.recording.output_names.index(self.plant.sensors[sensor].column)

    def _gain(self, sensor: int, readings: Tensor, mask: Tensor, model: Tensor) -> float:
        """Gain in a sensor's log-likelihood if its readings were these and the model's those, (S,) each."""
        blocked = self.as_is.blocked
        means, samples = blocked.means((readings - model).unsqueeze(1), mask.unsqueeze(1))
        mean_square = float((samples * means**2).sum() / samples.sum().clamp(min=1.0))
        ratio = float(self.as_is.variance[sensor]) / max(mean_square, float(blocked.noise[sensor]))
        return 0.5 * float(self.as_is.means[sensor]) * math.log(ratio)

    def _worth_fitting(self, *gains: float) -> bool:
        return sum(gains) + self.prior > 0.0

    def _units(self) -> Iterator[tuple[RecordingFault, float]]:
        """Wrong units of sensors; the power of ten follows from the ratio of median readings."""
        r, readings, model = self.recording, self.as_is.blocked.data.readings, self.as_is.readings
        for i, sensor in enumerate(self.plant.sensors):
            mask = self.as_is.blocked.data.mask[:, i]
            level, expected = (
                float((x[mask, i] - sensor.offset).abs().median()) if bool(mask.any()) else 0.0
                for x in (readings, model)
            )
            decade = round(math.log10(level / expected)) if level > 0.0 and expected > 0.0 else 0
            # Jacobian of the change of unit: an error of the level is 10^k times as large in the recorded numbers.
            jacobian = float(self.as_is.means[i]) * decade * math.log(10.0)
            gain = self._gain(i, readings[:, i] / 10.0**decade, mask, model[:, i]) - jacobian
            if decade in DECADES and self._worth_fitting(gain):
                outputs = r.outputs.clone()
                outputs[:, self._column(i)] /= 10.0**decade
                yield _wrong_unit(sensor.column, decade), self._weight(replace(r, outputs=outputs)) - jacobian

    def _units_of_inputs(self) -> Iterator[tuple[RecordingFault, float]]:
        """Wrong units of inputs.

        Tested only if the mean, or the mean movement, of some level is off by the factor that the loss of one of
        MOST_INPUTS equal flows causes at equilibrium, where a level is proportional to the flow squared. A unit that is
        wrong by a factor of ten causes about that or more.
        """
        r, data = self.recording, self.as_is.blocked.data
        readings = torch.where(data.mask, data.readings, torch.nan)
        model = torch.where(data.mask, self.as_is.readings, torch.nan)
        levels = [x.nanmean(dim=0) for x in (readings, model)]
        moves = [(x - x.nanmean(dim=0)).abs().nanmean(dim=0) for x in (readings, model)]
        decades_off = [torch.log10((a / b).abs()).abs().nan_to_num(0.0).max() for a, b in (levels, moves)]
        if max(float(x) for x in decades_off) < 2.0 * math.log10(MOST_INPUTS / (MOST_INPUTS - 0.9)):
            return
        for channel in self.plant.channels():
            fits: list[tuple[float, int, Recording]] = []
            for decade in DECADES:
                inputs = r.inputs.clone()
                inputs[:, r.input_names.index(channel)] /= 10.0**decade
                corrected = replace(r, inputs=inputs)
                fits.append((self._fit(corrected, preliminary=True).log_likelihood, decade, corrected))
            _, decade, corrected = max(fits, key=lambda fit: fit[0])
            yield _wrong_unit(channel, decade), self._weight(corrected)

    def _swapped(self) -> Iterator[tuple[RecordingFault, float]]:
        """Pairs of swapped sensors of one calibration."""
        r, data, model = self.recording, self.as_is.blocked.data, self.as_is.readings
        for (k, a), (n, b) in combinations(enumerate(self.plant.sensors), 2):
            gains = [self._gain(x, data.readings[:, y], data.mask[:, y], model[:, x]) for x, y in ((k, n), (n, k))]
            if (a.unit, a.gain, a.offset) == (b.unit, b.gain, b.offset) and self._worth_fitting(*gains):
                names = list(r.output_names)
                i, j = self._column(k), self._column(n)
                names[i], names[j] = names[j], names[i]
                yield _swap(a.column, b.column), self._weight(replace(r, output_names=tuple(names)))

    def _swapped_inputs(self) -> Iterator[tuple[RecordingFault, float]]:
        """The likeliest pair of swapped inputs of one unit."""
        units, r = self.plant.channel_units(), self.recording
        swaps: list[tuple[float, tuple[str, str], Recording]] = []
        for first, second in combinations(self.plant.channels(), 2):
            i, j = r.input_names.index(first), r.input_names.index(second)
            if units[first] == units[second] and not torch.equal(r.inputs[:, i], r.inputs[:, j]):
                names = list(r.input_names)
                names[i], names[j] = names[j], names[i]
                corrected = replace(r, input_names=tuple(names))
                blocked = blocked_recording(self.plant, thinned(corrected), noise_of(self.plant, r))
                swaps.append((first_order_log_likelihood(blocked, self.as_is), (first, second), corrected))
        if swaps:
            expected, pair, corrected = max(swaps, key=lambda swap: swap[0])
            if self._worth_fitting(expected - self.as_is.log_likelihood):
                yield _swap(*pair), self._weight(corrected)

    def _clocks(self) -> Iterator[tuple[RecordingFault, float]]:
        """Clock offsets of all sensors together and of each sensor alone; the delay by Gauss-Newton."""
        sensors = range(len(self.plant.sensors))
        interval = self.as_is.blocked.recording.interval
        for late in [list(sensors), *([i] for i in sensors if len(sensors) > 1)]:
            delay, gain = self._initial_delay(late)
            if not self._worth_fitting(gain):
                continue
            corrected = self._fit(self._shifted(late, delay))
            for _ in range(DELAY_CORRECTIONS):
                correction = _remaining_delay(corrected, late)
                delay += correction
                corrected = self._fit(self._shifted(late, delay))
                if abs(correction) < DELAY_TOLERANCE * interval:
                    break
            cost = 0.5 * math.log(float(corrected.means.sum()))
            columns = tuple(self.plant.sensors[i].column for i in late)
            yield _late(columns, delay, len(late) == len(sensors)), corrected.log_likelihood - cost

    def _shifted(self, late: list[int], delay: float) -> Recording:
        """The recording with some sensors' readings `delay` seconds earlier; unknown readings are masked."""
        r = self.recording
        outputs, mask = r.outputs.clone(), r.mask.clone()
        for column in map(self._column, late):
            valid = mask[:, column].clone()
            times = r.time[valid]
            at = r.time + delay
            if len(times):
                outputs[:, column] = interpolate(at, times, r.outputs[valid, column])
                mask[:, column] &= (at >= times[0]) & (at <= times[-1])
        return replace(r, outputs=outputs, mask=mask)

    def _initial_delay(self, late: list[int]) -> tuple[float, float]:
        """The likeliest delay (s) in whole samples of the thinned recording, and its gain in log-likelihood."""
        blocked, model = self.as_is.blocked, self.as_is.readings[:, late]
        most = int(MAX_DELAY * len(model))
        mean_square = _mean_square(blocked.data.readings[:, late], model, blocked.data.mask[:, late], most)
        log_likelihood = -0.5 * (torch.log(mean_square + blocked.noise[late]) @ self.as_is.means[late])
        best = int(log_likelihood.argmax())
        return (best - most) * blocked.recording.interval, float(log_likelihood[best] - log_likelihood[most])

    def _silent(self) -> Iterator[tuple[RecordingFault, float]]:
        """Sensors whose noise exceeds the movement of their level, and sensors that never move."""
        blocked, r = self.as_is.blocked, self.recording
        for i, sensor in enumerate(self.plant.sensors):
            constant, noise = sensor.column in self.constant, float(noise_of(self.plant, r)[i])
            valid = blocked.data.mask[:, i]
            if not bool(valid.any()) or not (constant or noise > float(self.as_is.readings[:, i].std())):
                continue
            mask = r.mask.clone()
            mask[:, self._column(i)] = False
            others = self._fit(replace(r, mask=mask)).log_likelihood
            mean = blocked.data.readings[valid, i].mean()
            gain = self._gain(i, blocked.data.readings[:, i], valid, mean.expand(len(valid)))
            log_likelihood = -0.5 * float(self.as_is.means[i] * torch.log(self.as_is.variance[i]))
            yield _unrelated(sensor, constant), others + log_likelihood + gain


def _mean_square(readings: Tensor, model: Tensor, mask: Tensor, most: int) -> Tensor:
    """Mean square of readings[k + lag] - model[k] over the valid readings, for lags of -most to most samples.

    readings, model, mask (S, C) -> (2 most + 1, C), by fast Fourier transforms.
    """
    center = torch.where(mask, readings, 0.0).sum(dim=0) / mask.sum(dim=0).clamp(min=1)
    x, m, keep = torch.where(mask, readings - center, 0.0), model - center, mask.to(readings.dtype)
    size = 2 * len(m)

    def correlation(a: Tensor, b: Tensor) -> Tensor:
        whole = torch.fft.irfft(torch.fft.rfft(a, size, dim=0) * torch.fft.rfft(b, size, dim=0).conj(), size, dim=0)
        return torch.cat([whole[size - most :], whole[: most + 1]])

    one = torch.ones_like(m)
    square = correlation(x**2, one) - 2.0 * correlation(x, m) + correlation(keep, m**2)
    return square.clamp(min=0.0) / correlation(keep, one).clamp(min=1.0)


def _remaining_delay(fit: BlockwiseFit, late: list[int]) -> float:
    """The delay (s) that remains in these sensors' readings: least squares for r = -delay dm/dt, weighted by 1/v_c."""
    blocked, model = fit.blocked, fit.readings[:, late]
    slope = torch.gradient(model, spacing=(blocked.recording.time,), dim=0)[0]
    mask, weight = blocked.data.mask[:, late], 1.0 / fit.variance[late]
    residual = torch.where(mask, blocked.data.readings[:, late] - model, 0.0)
    slope = torch.where(mask, slope, 0.0)
    return -float((residual * slope * weight).sum() / (slope * slope * weight).sum().clamp(min=1e-300))


def _wrong_unit(channel: str, decade: int) -> RecordingFault:
    times = f"{10 ** abs(decade)} times too {'large' if decade > 0 else 'small'}"
    fix = f"columns: {{{channel}: {{unit: ...}}}}"
    return RecordingFault(
        (channel,), f"{channel}: its unit seems wrong: its values are {times}; state the unit under {fix}"
    )


def _swap(a: str, b: str) -> RecordingFault:
    fix = f"columns: {{{a}: {{column: {b}}}, {b}: {{column: {a}}}}}"
    return RecordingFault((a, b), f"{a} and {b} seem to be swapped; assign the columns, as in {fix}")


def _late(columns: tuple[str, ...], delay: float, everything: bool) -> RecordingFault:
    what = "the readings" if everything else ", ".join(columns)
    reference = "the inputs" if everything else "the other channels"
    text = (
        f"{what}: the clock seems to run {abs(delay):.3g} s {'behind' if delay > 0 else 'ahead of'} that of "
        f"{reference}; "
        "state the shift of each file under columns: {t: {shift: ...}}"
    )
    return RecordingFault(("all",) if everything else columns, text, physical=delay > 0 and not everything)


def _unrelated(sensor: Sensor, constant: bool) -> RecordingFault:
    if constant:
        return RecordingFault((sensor.column,), f"{sensor.column} is stuck", True)
    text = (
        f"{sensor.column}: its readings do not follow the level of {sensor.tank}: they scatter by more than the level "
        "moves; check its wiring, or leave the sensor out of the plant file"
    )
    return RecordingFault((sensor.column,), text, True)
