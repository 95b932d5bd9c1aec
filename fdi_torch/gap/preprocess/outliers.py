"""Outliers of the readings: spikes and drop-outs, which no tank can cause, detected and masked before a fit.

A level is the integral of flows. A reading that jumps within one sample and soon returns is therefore a fault of the
sensor or its wiring. A jump that persists is no outlier. Outliers are searched in the residual of the fitted plant,
which is smooth whatever else is wrong. Stuck readings are masked before (`acquisition.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import median

import torch
from torch import Tensor

from fdi_torch.gap.candidate import Candidate
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.channel_noise import Noise
from fdi_torch.gap.dataset import DataSet, at_recorded_times
from fdi_torch.recording import Recording
from fdi_torch.recordings.repeated_readings import resolution

JUMP_THRESHOLD = 5.0  # in usual differences of neighbours, that is seven standard deviations of white noise
TIMING_ERROR = 3.0  # samples; a change that the slope of the level makes within this time is no jump
HALF_WINDOW = 5  # samples before and after a jump, whose median is the undisturbed reading
RETURN_SHARE = 0.3  # of an outlier's height, to within which the reading must return
MIN_READINGS = 100  # of a sensor
RETURN_CANDIDATES = 8  # jumps after one that may end it; a spike ends with the next
LARGEST_SHARE = 0.1  # of a sensor's readings; more of them are no outliers but its normal behaviour
PASSES = 3  # each with a fit that leaves out the outliers found before
# In units of JUMP_THRESHOLD; the median outlier of heavy-tailed noise is smaller (Laplace 1.1, Student's t with three
# degrees of freedom 1.26).
CLEAR_FACTOR = 1.4
MIN_OUTLIERS, MIN_SAMPLES = 3, 6  # with so many outliers, or samples in all, something is wrong with the sensor


@dataclass(frozen=True)
class Outlier:
    """One run of successive outlying readings of a sensor.

    rows: their samples. times: of the first and the last, s. jumps: their height over the usual difference of
    neighbouring readings; infinite for stuck readings.
    """

    rows: slice
    times: tuple[float, float]
    jumps: float


@dataclass(frozen=True)
class SensorOutliers:
    """All outliers of one sensor in one recording."""

    sensor: str
    source: str
    each: tuple[Outlier, ...]

    @property
    def samples(self) -> int:
        return sum(s.rows.stop - s.rows.start for s in self.each)

    @property
    def significant(self) -> bool:
        """Whether they show a faulty sensor: more than a few, and larger than those of heavy-tailed noise."""
        far = [s.jumps for s in self.each if s.jumps > JUMP_THRESHOLD]
        many = len(self.each) >= MIN_OUTLIERS or self.samples >= MIN_SAMPLES
        return many and bool(far) and median(far) > CLEAR_FACTOR * JUMP_THRESHOLD


def outliers_of(recording: Recording, lay_out: Callable[[Sequence[Recording]], DataSet]) -> tuple[SensorOutliers, ...]:
    """Outliers of each sensor that has some. lay_out: the data set of recordings, which may average readings."""
    outliers: dict[str, list[Outlier]] = {}
    masked = recording
    for _ in range(PASSES):
        data, mask = lay_out([masked]), masked.mask
        model = at_recorded_times(data, _fitted_readings(data))
        for i, sensor in enumerate(data.plant.sensors):
            c = recording.output_names.index(sensor.column)
            new_outliers = _channel_outliers(masked, model[:, i], c)
            new_mask = without(mask, new_outliers, c)
            if new_outliers and int((recording.mask & ~new_mask)[:, c].sum()) <= LARGEST_SHARE * int(
                recording.mask[:, c].sum()
            ):
                outliers.setdefault(sensor.name, []).extend(new_outliers)
                mask = new_mask
        if mask is masked.mask:
            break
        masked = replace(masked, mask=mask)
    return tuple(
        SensorOutliers(s.name, recording.source, tuple(sorted(outliers[s.name], key=lambda each: each.rows.start)))
        for s in data.plant.sensors
        if s.name in outliers
    )


def sensor_with_outliers(sensors: Sequence[SensorOutliers]) -> str | None:
    """The sensor with the most outlying readings, if they show that it is faulty."""
    faulty = [s for s in sensors if s.significant]
    return max(faulty, key=lambda s: s.samples).sensor if faulty else None


def without(mask: Tensor, outliers: Sequence[Outlier], channel: int) -> Tensor:
    """The mask (S, C) without these readings of a channel."""
    reduced = mask.clone()
    for outlier in outliers:
        reduced[outlier.rows, channel] = False
    return reduced


def _fitted_readings(data: DataSet) -> Tensor:
    """Readings (S, C) of the plant with its constants fitted."""
    readings = torch.where(data.mask, data.readings, torch.nan)
    size = (readings - readings.nanmedian(dim=0).values).abs().nanmedian(dim=0).values.clamp(min=1e-9)
    return Fitter(data, Noise.white(1e-2 * size)).fit(Candidate()).linearised.readings[0]


def _channel_outliers(recording: Recording, model: Tensor, channel: int) -> list[Outlier]:
    """Outliers of one channel of a recording whose readings a model (S,) predicts."""
    at = recording.mask[:, channel].nonzero().flatten()
    if len(at) < MIN_READINGS:
        return []
    values, predicted, time = recording.outputs[at, channel], model[at], recording.time[at]
    spans = jumps_and_returns(values - predicted, torch.diff(predicted).abs(), resolution(values))
    return [
        Outlier(slice(int(at[a]), int(at[b - 1]) + 1), (float(time[a]), float(time[b - 1])), jumps)
        for a, b, jumps in spans
    ]


def jumps_and_returns(x: Tensor, slope: Tensor, least: float) -> list[tuple[int, int, float]]:
    """Segments in which x (n,) leaves its previous value within one sample and returns within one: first sample, first
    sample after, height in usual differences.

    slope (n - 1,): movement of the level between samples. least: smallest difference that counts.
    """
    change = torch.diff(x)
    usual = max(1.4826 * float((change - change.median()).abs().median()), least)
    movement = torch.nn.functional.max_pool1d(slope.reshape(1, 1, -1), 2 * HALF_WINDOW + 1, 1, HALF_WINDOW).flatten()
    limit = JUMP_THRESHOLD * usual + TIMING_ERROR * movement
    jumps = (change.abs() > limit).nonzero().flatten().tolist()
    longest, values = int(LARGEST_SHARE * len(x)), x.tolist()
    if len(jumps) > 2 * longest:
        return []
    segments: list[tuple[int, int, float]] = []
    for n, last in enumerate(jumps):
        if segments and last < segments[-1][1]:
            continue
        before = median(values[max(last + 1 - HALF_WINDOW, 0) : last + 1])
        for back in jumps[n + 1 : n + 1 + RETURN_CANDIDATES]:
            if back - last > longest:
                break
            block, following = values[last + 1 : back + 1], values[back + 1 : back + 1 + HALF_WINDOW]
            middle = 0.5 * (before + median(following))
            height = median(abs(v - middle) for v in block)
            mismatch = max(abs(median(following) - before), abs(following[0] - middle), abs(values[last] - middle))
            if height > float(limit[last]) and mismatch < RETURN_SHARE * height:
                # The samples before and after, as many as the block has, decide which of the two is the outlier.
                around = values[max(2 * last + 1 - back, 0) : last + 1] + values[back + 1 : 2 * back + 1 - last]
                if median(abs(v - median(around)) for v in block) > 0.5 * height:
                    segments.append((last + 1, back + 1, height / usual))
                    values[last + 1 : back + 1] = [before] * len(block)
                    break
    return segments
