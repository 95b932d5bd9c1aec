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

from torch import Tensor

from fdi_torch.gap.preprocess.corrected_fit import CorrectedFits, Suspicion
from fdi_torch.gap.preprocess.recording_fault_texts import swapped, wrong_unit
from fdi_torch.recording import Recording

DECADES = (-3, -2, -1, 1, 2, 3)
"""Powers of ten by which a unit can be wrong; millimetres instead of metres at most."""


def units_of_sensors(fits: CorrectedFits) -> Iterator[Suspicion]:
    """Wrong units of sensors; the power of ten follows from the ratio of median readings."""
    r, readings, model = fits.thinned, fits.as_is.blocked.data.readings, fits.as_is.readings
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
        corrected, noise = replace(r, outputs=outputs), fits.noise.clone()
        noise[i] /= 10.0**decade
        # Jacobian of the change of unit: an error of the level is 10^k times as large in the recorded numbers.
        jacobian = float(fits.as_is.means[i]) * decade * math.log(10.0)
        yield from fits.suspicion(wrong_unit(sensor.column, decade), corrected, noise, jacobian)


def units_of_inputs(fits: CorrectedFits) -> Iterator[Suspicion]:
    """The likeliest wrong unit of each input."""
    for channel in fits.plant.channels():
        corrected = {decade: _with_unit(fits.thinned, channel, decade) for decade in DECADES}
        gains = {decade: fits.first_order_gain(each) for decade, each in corrected.items()}
        decade = max(gains, key=gains.__getitem__)
        yield from fits.suspicion(wrong_unit(channel, decade), corrected[decade])


def _with_unit(recording: Recording, channel: str, decade: int) -> Recording:
    inputs = recording.inputs.clone()
    inputs[:, recording.input_names.index(channel)] /= 10.0**decade
    return replace(recording, inputs=inputs)


def swapped_sensors(fits: CorrectedFits) -> Iterator[Suspicion]:
    """The likeliest pair of swapped sensors of one calibration."""
    pairs = [
        (a.column, b.column)
        for a, b in combinations(fits.plant.sensors, 2)
        if (a.unit, a.gain, a.offset) == (b.unit, b.gain, b.offset)
    ]
    r, columns = fits.thinned, tuple(s.column for s in fits.plant.sensors)

    def correct(a: str, b: str) -> tuple[Recording, Tensor]:
        order = [columns.index(name) for name in _exchanged(columns, a, b)]
        return replace(r, output_names=_exchanged(r.output_names, a, b)), fits.noise[order]

    return _likeliest_swap(fits, pairs, correct)


def swapped_inputs(fits: CorrectedFits) -> Iterator[Suspicion]:
    """The likeliest pair of swapped inputs of one unit."""
    units, r = fits.plant.channel_units(), fits.thinned
    pairs = [(a, b) for a, b in combinations(fits.plant.channels(), 2) if units[a] == units[b]]
    return _likeliest_swap(
        fits, pairs, lambda a, b: (replace(r, input_names=_exchanged(r.input_names, a, b)), fits.noise)
    )


def _likeliest_swap(
    fits: CorrectedFits, pairs: Iterable[tuple[str, str]], correct: Callable[[str, str], tuple[Recording, Tensor]]
) -> Iterator[Suspicion]:
    """The pair with the largest gain. correct: the recording with a pair exchanged, its noise."""
    gains = {pair: fits.first_order_gain(*correct(*pair)) for pair in pairs}
    pair = max(gains, key=gains.__getitem__, default=None)
    if pair:
        yield from fits.suspicion(swapped(*pair), *correct(*pair))


def _exchanged(names: tuple[str, ...], a: str, b: str) -> tuple[str, ...]:
    return tuple({a: b, b: a}.get(name, name) for name in names)
