"""Channels with a wrong unit and pairs of swapped channels.

    wrong unit        y = 10^k y'           k = -3 ... 3, of one sensor or one input
    swapped channels  y_a = y'_b, y_b = y'_a    two sensors, or two inputs, of one unit

Of all swapped pairs only the likeliest is fitted: that with the largest gain to first order in the constants.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import combinations

import torch

from fdi_torch.gap.preprocess.corrected_fit import CorrectedFits, WeightedFault
from fdi_torch.gap.preprocess.recording_fault_texts import swapped, wrong_unit
from fdi_torch.recording import Recording

DECADES = (-3, -2, -1, 1, 2, 3)
"""Powers of ten by which a unit can be wrong; millimetres instead of metres at most."""
MOST_INPUTS = 8
"""Inputs of equal flow into one tank, of which one with a wrong unit still shows in the mean level."""


def units_of_sensors(fits: CorrectedFits) -> Iterator[WeightedFault]:
    """Wrong units of sensors; the power of ten follows from the ratio of median readings."""
    r, readings, model = fits.recording, fits.as_is.blocked.data.readings, fits.as_is.readings
    for i, sensor in enumerate(fits.plant.sensors):
        mask = fits.as_is.blocked.data.mask[:, i]
        level, expected = (
            float((x[mask, i] - sensor.offset).abs().median()) if bool(mask.any()) else 0.0 for x in (readings, model)
        )
        decade = round(math.log10(level / expected)) if level > 0.0 and expected > 0.0 else 0
        if decade not in DECADES:
            continue
        outputs = r.outputs.clone()
        outputs[:, fits.column(i)] /= 10.0**decade
        corrected = replace(r, outputs=outputs)
        # Jacobian of the change of unit: an error of the level is 10^k times as large in the recorded numbers.
        jacobian = float(fits.as_is.means[i]) * decade * math.log(10.0)
        if fits.worth_fitting(fits.first_order_gain(corrected) - jacobian):
            yield fits.weighted(wrong_unit(sensor.column, decade), corrected, jacobian)


def units_of_inputs(fits: CorrectedFits) -> Iterator[WeightedFault]:
    """Wrong units of inputs.

    Tested only if the mean, or the mean movement, of some level is off by the factor that the loss of one of
    MOST_INPUTS equal flows causes at equilibrium, where a level is proportional to the flow squared. A unit that is
    wrong by a factor of ten causes about that or more.
    """
    r, data = fits.recording, fits.as_is.blocked.data
    readings = torch.where(data.mask, data.readings, torch.nan)
    model = torch.where(data.mask, fits.as_is.readings, torch.nan)
    levels = [x.nanmean(dim=0) for x in (readings, model)]
    moves = [(x - x.nanmean(dim=0)).abs().nanmean(dim=0) for x in (readings, model)]
    decades_off = [torch.log10((a / b).abs()).abs().nan_to_num(0.0).max() for a, b in (levels, moves)]
    if max(float(x) for x in decades_off) < 2.0 * math.log10(MOST_INPUTS / (MOST_INPUTS - 0.9)):
        return
    for channel in fits.plant.channels():
        candidates: list[tuple[float, int, Recording]] = []
        for decade in DECADES:
            inputs = r.inputs.clone()
            inputs[:, r.input_names.index(channel)] /= 10.0**decade
            corrected = replace(r, inputs=inputs)
            candidates.append((fits.fit(corrected, preliminary=True).log_likelihood, decade, corrected))
        _, decade, corrected = max(candidates, key=lambda each: each[0])
        yield fits.weighted(wrong_unit(channel, decade), corrected)


def swapped_sensors(fits: CorrectedFits) -> Iterator[WeightedFault]:
    """The likeliest pair of swapped sensors of one calibration."""
    pairs = [
        (a.column, b.column)
        for a, b in combinations(fits.plant.sensors, 2)
        if (a.unit, a.gain, a.offset) == (b.unit, b.gain, b.offset)
    ]
    r = fits.recording
    return _likeliest_swap(fits, pairs, lambda a, b: replace(r, output_names=_exchanged(r.output_names, a, b)))


def swapped_inputs(fits: CorrectedFits) -> Iterator[WeightedFault]:
    """The likeliest pair of swapped inputs of one unit."""
    units, r = fits.plant.channel_units(), fits.recording
    pairs = [(a, b) for a, b in combinations(fits.plant.channels(), 2) if units[a] == units[b]]
    return _likeliest_swap(fits, pairs, lambda a, b: replace(r, input_names=_exchanged(r.input_names, a, b)))


def _likeliest_swap(
    fits: CorrectedFits, pairs: Iterable[tuple[str, str]], correct: Callable[[str, str], Recording]
) -> Iterator[WeightedFault]:
    """The pair with the largest gain, if it is worth a fit. correct: the recording with a pair exchanged."""
    gains = {pair: fits.first_order_gain(correct(*pair)) for pair in pairs}
    pair = max(gains, key=gains.__getitem__, default=None)
    if pair and fits.worth_fitting(gains[pair]):
        yield fits.weighted(swapped(*pair), correct(*pair))


def _exchanged(names: tuple[str, ...], a: str, b: str) -> tuple[str, ...]:
    return tuple({a: b, b: a}.get(name, name) for name in names)
