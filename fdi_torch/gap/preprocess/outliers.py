"""Readings that stray: spikes and drop-outs, which no tank can make, told and masked before anything is searched.

A level is the integral of flows, so that a reading which jumps within one sample and soon jumps back to where it was
tells of the sensor and its wire alone. A jump that stays is no stray. They are looked for in what the believed plant
leaves, which runs smoothly whatever else is wrong. Readings that stand still are masked before (`acquisition.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import median

import torch
from torch import Tensor

from fdi_torch.gap.candidate_fit import Candidate, Fitter
from fdi_torch.gap.dataset import DataSet
from fdi_torch.gap.noise_model import Noise

FAR = 5.0  # times what neighbouring samples usually differ by, for a jump: in white noise seven standard deviations
NEARER = 3.5  # the same of a sensor that is known to stray
LATE = 3.0  # samples by which a reading may come early or late: what its slope makes of them is no jump
WING = 5  # samples to either side, whose median is where the reading was
BACK = 0.3  # of the height of a stray, to within which the reading has to come back
ENOUGH = 100  # readings of a sensor, among which it can be told what strays
RETURNS = 8  # jumps after one, with which it may come back: that of a spike is the next
MOST = 0.1  # share of a sensor's readings, beyond which they do not stray but are how it reads
PASSES = 3  # each about a fit that knows nothing of the strays found before
CLEAR = 1.4  # times FAR: of noise with heavy tails (Laplace's 1.1, Student's with three degrees of freedom 1.26) the
# middle one of all beyond FAR lies nearer
EVENTS, SAMPLES = 3, 6  # so many, or so many samples in all, are no accident but something wrong with the sensor


@dataclass(frozen=True)
class Outlier:
    """rows: its samples, in a row. times: of the first and the last, s, on the recording's clock. jumps: how far out it
    lies, in multiples of what neighbouring samples usually differ by; infinite for a reading that stood still.
    """

    rows: slice
    times: tuple[float, float]
    jumps: float


@dataclass(frozen=True)
class SensorOutliers:
    """All of one sensor in one recording."""

    sensor: str
    source: str
    each: tuple[Outlier, ...]

    @property
    def samples(self) -> int:
        return sum(s.rows.stop - s.rows.start for s in self.each)

    @property
    def clear(self) -> bool:
        """Whether they are more than an accident, or than what a noise with heavy tails makes."""
        far = [s.jumps for s in self.each if s.jumps > FAR]
        many = len(self.each) >= EVENTS or self.samples >= SAMPLES
        return many and bool(far) and median(far) > CLEAR * FAR


def outliers_of(data: DataSet) -> tuple[SensorOutliers, ...]:
    """Of each sensor that has some. subject: of one recording."""
    found: dict[int, list[Outlier]] = {}
    given, mask = data.mask, data.mask
    for _ in range(PASSES):
        model, new = _believed(replace(data, mask=mask)), mask.clone()
        for c in range(mask.shape[1]):
            far = NEARER if len(found.get(c, [])) >= EVENTS else FAR
            own = _strays(data, model[:, c], mask[:, c], c, far)
            lost = int((~mask[:, c] & given[:, c]).sum()) + sum(s.rows.stop - s.rows.start for s in own)
            if own and lost <= MOST * int(given[:, c].sum()):
                found.setdefault(c, []).extend(own)
                new = without(new, own, c)
        if bool((new == mask).all()):
            break
        mask = new
    sensors, source = data.plant.sensors, data.recording.source
    each = {c: tuple(sorted(own, key=lambda s: s.rows.start)) for c, own in sorted(found.items())}
    return tuple(SensorOutliers(sensors[c].name, source, own) for c, own in each.items())


def sensor_with_outliers(found: Sequence[SensorOutliers]) -> str | None:
    """The sensor of which most readings stray, if any strays by more than an accident."""
    clear = [s for s in found if s.clear]
    return max(clear, key=lambda s: s.samples).sensor if clear else None


def without(mask: Tensor, strays: Sequence[Outlier], channel: int) -> Tensor:
    """mask (S, C) less these readings of a channel."""
    left = mask.clone()
    for stray in strays:
        left[stray.rows, channel] = False
    return left


def _believed(data: DataSet) -> Tensor:
    """What the plant with its constants fitted reads, (S, C)."""
    seen = torch.where(data.mask, data.readings, torch.nan)
    size = (seen - seen.nanmedian(dim=0).values).abs().nanmedian(dim=0).values.clamp(min=1e-9)
    return Fitter(data, Noise(1e-2 * size, torch.zeros_like(size))).fit(Candidate()).linearised.readings[0]


def _strays(data: DataSet, model: Tensor, mask: Tensor, channel: int, far: float) -> list[Outlier]:
    at = mask.nonzero().flatten()
    if len(at) < ENOUGH:
        return []
    values, believed, time = data.readings[at, channel], model[at], data.recording.time[at]
    spans = jumps_and_returns(values - believed, torch.diff(believed).abs(), _resolution(values), far)
    return [
        Outlier(slice(int(at[a]), int(at[b - 1]) + 1), (float(time[a]), float(time[b - 1])), jumps)
        for a, b, jumps in spans
    ]


def _resolution(values: Tensor) -> float:
    """The least distance between two values (S,) of a channel."""
    distinct = torch.unique(values)
    return float(torch.diff(distinct).min()) if len(distinct) > 1 else 0.0


def jumps_and_returns(x: Tensor, slope: Tensor, least: float, far: float = FAR) -> list[tuple[int, int, float]]:
    """Where x (n,) leaves within one sample what is before it, and comes back to it within one: the first sample, the
    first beyond, and the height as a multiple of the usual difference.

    slope (n - 1,): by how much the level moves from sample to sample; least: difference that counts; far: as FAR.
    """
    change = torch.diff(x)
    usual = max(1.4826 * float((change - change.median()).abs().median()), least)
    moves = torch.nn.functional.max_pool1d(slope.reshape(1, 1, -1), 2 * WING + 1, 1, WING).flatten()
    limit = far * usual + LATE * moves
    jumps = (change.abs() > limit).nonzero().flatten().tolist()
    longest, values = int(MOST * len(x)), x.tolist()
    if len(jumps) > 2 * longest:
        return []
    found: list[tuple[int, int, float]] = []
    strayed: set[int] = set()
    for n, last in enumerate(jumps):
        if found and last < found[-1][1]:
            continue
        steady = [k for k in range(max(last - longest, 0), last + 1) if k not in strayed]
        was = median(values[k] for k in steady[-WING:])
        for back in jumps[n + 1 : n + 1 + RETURNS]:
            if back - last > longest:
                break
            block, beyond = values[last + 1 : back + 1], values[back + 1 : back + 1 + WING]
            middle = 0.5 * (was + median(beyond))
            height = median(abs(v - middle) for v in block)
            astray = max(abs(median(beyond) - was), abs(beyond[0] - middle), abs(values[last] - middle))
            if height > float(limit[last]) and astray < BACK * height:
                # What lies as long before and after decides which of the two is the stray.
                around = [values[k] for k in steady[-len(block) :]] + values[back + 1 : back + 1 + len(block)]
                if median(abs(v - median(around)) for v in block) > 0.5 * height:
                    found.append((last + 1, back + 1, height / usual))
                    strayed.update(range(last + 1, back + 1))
                    break
    return found
