"""Faults of a recording, as opposed to faults of the plant: each is a hypothesis that can be tested.

    wrong unit        y = 10^k y'               k = -3 ... 3, of one sensor or one input, if y' is possible
    swapped channels  y_a = y'_b, y_b = y'_a    two sensors of one calibration, or two inputs of one unit
    clock offset      `clock_offset.py`
    silent sensor     y = mean + scatter, whatever the level

Another, commands that move faster than their samples, shows in the readings alone (`recordings/input_sampling.py`).

A hypothesis undoes its fault in the recording. Its weight is the log-likelihood of the corrected recording
(`blockwise_likelihood.py`) plus the log prior. Of hypotheses that exclude each other, such as the powers of ten of one
channel, only the likeliest to first order in the constants is fitted, and only if its gain in log-likelihood exceeds
the cost of its prior. `recording_fault_decision.py` compares the weights with those of the unchanged recording.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Hashable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain, combinations
from operator import itemgetter

import torch
from torch import Tensor

from fdi_torch.gap.preprocess.clock_offset import clock_offsets
from fdi_torch.gap.preprocess.corrected_fit import CorrectedFits, Correction
from fdi_torch.gap.preprocess.recording_fault_texts import RecordingFault, stuck, swapped, unrelated, wrong_unit
from fdi_torch.recording import Recording
from fdi_torch.recordings.plant_units import exceeds_limits

DECADES = (-3, -2, -1, 1, 2, 3)
"""Powers of ten by which a unit can be wrong; millimetres instead of metres at most."""


def suspected(fits: CorrectedFits, constant: Collection[str], thorough: bool) -> list[tuple[float, Correction]]:
    """All corrections that are worth a fit, with their gain in log posterior weight to first order, the largest first.

    constant: columns of sensors that never move. thorough: the likeliest, and the likeliest swaps, are worth a fit even
    without a gain, because the plant may have an effect as well.
    """
    alternatives = chain(_units(fits), _swaps(fits), clock_offsets(fits), _silent_sensors(fits, constant))
    likeliest = [max(((fits.first_order_gain(c), c) for c in each), key=itemgetter(0)) for each in alternatives if each]
    ranked = sorted(likeliest, key=itemgetter(0), reverse=True)
    worth = [thorough and (k == 0 or each.fault.swapped) for k, (_, each) in enumerate(ranked)]
    return [item for item, though_no_gain in zip(ranked, worth, strict=True) if item[0] > 0.0 or though_no_gain]


def _units(fits: CorrectedFits) -> Iterator[list[Correction]]:
    """The wrong units of each sensor, and of each input, in which its values would be possible and not the same."""
    r, plant = fits.thinned, fits.plant
    for i, sensor in enumerate(plant.sensors):
        readings, of_sensor = r.valid_readings(sensor.column), []
        # Jacobian of the change of unit: an error of the level is 10^k times as large in the recorded numbers.
        cost = float(fits.as_is.means[i]) * math.log(10.0)
        for k in (k for k in DECADES if not exceeds_limits(plant, sensor.column, readings / 10.0**k)):
            corrected, noise = replace(r, outputs=_scaled(r.outputs, fits.column(i), k)), _scaled(fits.noise, i, k)
            of_sensor.append(Correction(wrong_unit(sensor.column, k), corrected, k * cost, noise))
        yield of_sensor
    for channel in plant.channels():
        column = r.input_names.index(channel)
        values = r.inputs[:, column]
        possible = [k for k in DECADES if bool(values.any()) and not exceeds_limits(plant, channel, values / 10.0**k)]
        yield [Correction(wrong_unit(channel, k), replace(r, inputs=_scaled(r.inputs, column, k))) for k in possible]


def _scaled(values: Tensor, column: int, decade: int) -> Tensor:
    """The values (*, C) with one column divided by 10^decade."""
    values = values.clone()
    values[..., column] /= 10.0**decade
    return values


def _swaps(fits: CorrectedFits) -> Iterator[list[Correction]]:
    """The pairs of sensors, and of inputs, that may be swapped."""
    r, columns = fits.thinned, fits.plant.outputs()
    alike = _alike({s.column: (s.unit, s.gain, s.offset) for s in fits.plant.sensors})
    noise = {p: fits.noise[[columns.index(name) for name in _exchanged(columns, p)]] for p in alike}
    sensors = {p: replace(r, output_names=_exchanged(r.output_names, p)) for p in alike}
    yield [Correction(swapped(*p), sensors[p], noise=noise[p]) for p in alike]
    values = dict(zip(r.input_names, r.inputs.T, strict=True))
    inputs = [(a, b) for a, b in _alike(fits.plant.channel_units()) if not torch.equal(values[a], values[b])]
    yield [Correction(swapped(*p), replace(r, input_names=_exchanged(r.input_names, p))) for p in inputs]


def _alike(channels: Mapping[str, Hashable]) -> list[tuple[str, str]]:
    """The pairs of channels with the same unit or calibration."""
    return [(a, b) for a, b in combinations(channels, 2) if channels[a] == channels[b]]


def _exchanged(names: Sequence[str], pair: tuple[str, str]) -> tuple[str, ...]:
    a, b = pair
    return tuple({a: b, b: a}.get(name, name) for name in names)


def _silent_sensors(fits: CorrectedFits, constant: Collection[str]) -> Iterator[list[Correction]]:
    """Sensors whose noise exceeds the movement of their level, and sets of sensors that never move.

    Those that never move are often stuck together, because one logger or one supply fails. Which of them are stuck is
    decided among nested sets: the first, the first two, ... of them. Their order follows from one fit without any of
    them, which no stuck sensor can bias: the one that lies furthest from that fit comes first. n such sensors need
    n + 1 fits.

    constant: columns of those that never move.
    """
    data, model = fits.as_is.blocked.data, fits.as_is.readings
    moves = model.std(dim=0)
    sensors = {i: s for i, s in enumerate(fits.plant.sensors) if bool(data.mask[:, i].any())}
    still = [i for i, s in sensors.items() if s.column in constant]
    for i, sensor in sensors.items():
        if i not in still and float(fits.noise[i]) > float(moves[i]):
            yield [_silence(fits, unrelated(sensor), [i])]
    if not still:
        return
    model = fits.fit(_without_sensors(fits, still)).readings

    def gain(i: int) -> float:
        return _about_mean(fits, i) - fits.channel_log_likelihood(i, data.readings[:, i] - model[:, i])

    ordered = sorted(still, key=gain, reverse=True)
    for count in range(1, len(ordered) + 1):
        some = ordered[:count]
        yield [_silence(fits, stuck([sensors[i].column for i in some]), some)]


def _silence(fits: CorrectedFits, fault: RecordingFault, silent: list[int]) -> Correction:
    """The hypothesis that these sensors are silent, each for a reason of its own."""
    explained = (len(silent) - 1) * fits.prior + sum(_about_mean(fits, i) for i in silent)
    return Correction(fault, _without_sensors(fits, silent), -explained)


def _without_sensors(fits: CorrectedFits, sensors: list[int]) -> Recording:
    mask = fits.thinned.mask.clone()
    mask[:, [fits.column(i) for i in sensors]] = False
    return replace(fits.thinned, mask=mask)


def _about_mean(fits: CorrectedFits, sensor: int) -> float:
    """Log-likelihood of a sensor's readings about their own mean."""
    data = fits.as_is.blocked.data
    readings = data.readings[:, sensor]
    return fits.channel_log_likelihood(sensor, readings - readings[data.mask[:, sensor]].mean())
