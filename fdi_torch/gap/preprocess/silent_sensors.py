"""Sensors whose readings do not depend on their level: y = mean + scatter.

Sensors that never move are often stuck together, because one logger or one supply fails. Which of them are stuck is
decided among nested sets: the first, the first two, ... of them. Their order follows from one fit without any of them,
which no stuck sensor can bias: the one that lies furthest from that fit comes first. n such sensors need n + 1 fits.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace

import torch

from fdi_torch.gap.preprocess.blockwise_likelihood import BlockwiseFit
from fdi_torch.gap.preprocess.corrected_fit import CorrectedFits, Suspicion, WeightedFault
from fdi_torch.gap.preprocess.recording_fault_texts import RecordingFault, stuck, unrelated


def silent_sensors(fits: CorrectedFits, constant: Collection[str]) -> Iterator[Suspicion]:
    """Sensors whose noise exceeds the movement of their level, and sets of sensors that never move.

    constant: columns of the latter.
    """
    data = fits.as_is.blocked.data
    moves = fits.as_is.readings.std(dim=0)
    readable = [i for i in range(len(fits.plant.sensors)) if bool(data.mask[:, i].any())]
    still = [i for i in readable if fits.plant.sensors[i].column in constant]
    for i in readable:
        if i not in still and float(fits.noise[i]) > float(moves[i]):
            yield _suspicion(fits, unrelated(fits.plant.sensors[i]), [i])
    if not still:
        return
    model = _fit_without(fits, still).readings

    def gain(i: int) -> float:
        misfit = fits.channel_log_likelihood(i, data.readings[:, i] - model[:, i], data.mask[:, i])
        return _log_likelihood(fits, i) - misfit

    ordered = sorted(still, key=gain, reverse=True)
    for count in range(1, len(ordered) + 1):
        some = ordered[:count]
        yield _suspicion(fits, stuck([fits.plant.sensors[i].column for i in some]), some)


def _suspicion(fits: CorrectedFits, fault: RecordingFault, silent: list[int]) -> Suspicion:
    """The hypothesis that these sensors are silent, each for a reason of its own."""
    known = len(silent) * fits.prior + sum(_log_likelihood(fits, i) for i in silent)

    def weigh() -> WeightedFault:
        return WeightedFault(fault, known + _fit_without(fits, silent).log_likelihood)

    # The other sensors are fitted at least as well as before.
    others = [i for i in range(len(fits.plant.sensors)) if i not in silent]
    as_before = -0.5 * float((fits.as_is.means * torch.log(fits.as_is.variance))[others].sum())
    return Suspicion(fault, known + as_before - 0.5 * fits.as_is.prior_chi_square, weigh)


def _fit_without(fits: CorrectedFits, sensors: list[int]) -> BlockwiseFit:
    mask = fits.thinned.mask.clone()
    mask[:, [fits.column(i) for i in sensors]] = False
    return fits.fit(replace(fits.thinned, mask=mask))


def _log_likelihood(fits: CorrectedFits, sensor: int) -> float:
    """Log-likelihood of a sensor's readings about their own mean."""
    data = fits.as_is.blocked.data
    valid = data.mask[:, sensor]
    readings = data.readings[:, sensor]
    return fits.channel_log_likelihood(sensor, readings - readings[valid].mean(), valid)
