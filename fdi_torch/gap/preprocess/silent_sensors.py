"""Sensors whose readings do not depend on their level: y = mean + scatter.

Sensors that never move are often stuck together, because one logger or one supply fails. Which of them are stuck is
decided among nested sets: the first, the first two, ... of them. Their order follows from one fit without any of them,
which no stuck sensor can bias: the one that lies furthest from that fit comes first. n such sensors need n + 1 fits.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace

from fdi_torch.gap.preprocess.corrected_fit import CorrectedFits, Correction
from fdi_torch.gap.preprocess.recording_fault_texts import RecordingFault, stuck, unrelated
from fdi_torch.recording import Recording


def silent_sensors(fits: CorrectedFits, constant: Collection[str]) -> Iterator[list[Correction]]:
    """Sensors whose noise exceeds the movement of their level, and sets of sensors that never move.

    constant: columns of the latter.
    """
    data, model = fits.as_is.blocked.data, fits.as_is.readings
    moves = model.std(dim=0)
    sensors = {i: s for i, s in enumerate(fits.plant.sensors) if bool(data.mask[:, i].any())}
    still = [i for i, s in sensors.items() if s.column in constant]
    for i, sensor in sensors.items():
        if i not in still and float(fits.noise[i]) > float(moves[i]):
            yield [_correction(fits, unrelated(sensor), [i])]
    if not still:
        return
    model = fits.fit(_without(fits, still)).readings

    def gain(i: int) -> float:
        return _about_mean(fits, i) - fits.channel_log_likelihood(i, data.readings[:, i] - model[:, i])

    ordered = sorted(still, key=gain, reverse=True)
    for count in range(1, len(ordered) + 1):
        some = ordered[:count]
        yield [_correction(fits, stuck([sensors[i].column for i in some]), some)]


def _correction(fits: CorrectedFits, fault: RecordingFault, silent: list[int]) -> Correction:
    """The hypothesis that these sensors are silent, each for a reason of its own."""
    explained = (len(silent) - 1) * fits.prior + sum(_about_mean(fits, i) for i in silent)
    return Correction(fault, _without(fits, silent), -explained)


def _without(fits: CorrectedFits, sensors: list[int]) -> Recording:
    mask = fits.thinned.mask.clone()
    mask[:, [fits.column(i) for i in sensors]] = False
    return replace(fits.thinned, mask=mask)


def _about_mean(fits: CorrectedFits, sensor: int) -> float:
    """Log-likelihood of a sensor's readings about their own mean."""
    data = fits.as_is.blocked.data
    readings = data.readings[:, sensor]
    return fits.channel_log_likelihood(sensor, readings - readings[data.mask[:, sensor]].mean())
