"""What is to be diagnosed, examined before any fit: what cannot be diagnosed is said in one sentence."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from fdi_torch.effects import effect
from fdi_torch.gap.dataset import DataSet, data_set_of
from fdi_torch.gap.library import library_of
from fdi_torch.gap.preprocess.acquisition import StuckSegment, usable, without_sensors
from fdi_torch.gap.preprocess.outliers import Outlier, SensorOutliers, outliers_of, without
from fdi_torch.gap.preprocess.sensor_limits import limits_from_readings
from fdi_torch.gap.search import DEEPEST
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.scales import time_scale
from fdi_torch.recording import Recording

LEAST = 60
"""Readings of a sensor below which its noise cannot be told from what a model gets wrong: two of the slowest periods
that still count as noise."""

LONGEST_STEP = 2.5  # s, for tanks on a bench: where a rim is met, fits in longer ones end wherever they began


@dataclass(frozen=True)
class Settings:
    """library, leave_out: as in `library_of`. step: of the simulation, s; None: as in `laid_out`.

    most: effects that one explanation may have. named_only: the best of what has a name, however much it leaves open:
    a step on the way where many causes come together. trusted: as in `Recording`, of all of them.
    """

    library: tuple[str, ...] | None = None
    leave_out: tuple[str, ...] = ()
    step: float | None = None
    most: int = DEEPEST
    named_only: bool = False
    trusted: bool = False


PLAIN = Settings()


@dataclass(frozen=True)
class DiagnosisProblem:
    """library: the effects at places to search. subject: the recordings, for the plant with the limits of its sensors
    that their values tell, and sensors that are stuck (`told`), without sensors that are stuck throughout; held: the
    hold-outs. strays: what was masked in the recordings, and in the hold-outs. most, named_only: as in `Settings`.
    """

    library: tuple[Placement, ...]
    recordings: tuple[Recording, ...]
    told: list[Placement]
    data: DataSet
    held: tuple[DataSet, ...]
    most: int
    named_only: bool = False
    strays: tuple[Sequence[SensorOutliers], Sequence[SensorOutliers]] = ((), ())


def problem_of(
    plant: PlantDescription, recordings: Sequence[Recording], holdouts: Sequence[Recording], settings: Settings
) -> DiagnosisProblem:
    """Raises ValueError for what cannot be diagnosed: effects or places that there are not, sensors or inputs that the
    recordings lack, too few readings, a hold-out that is the recording itself.
    """
    for one in holdouts:
        check_holdout_differs(one, recordings)
    library = library_of(plant, settings.library, settings.leave_out)
    longest = max(float(r.time[-1] - r.time[0]) for r in recordings)
    if settings.step is not None and settings.step > longest:
        raise ValueError(f"step: expected one within the {longest:g} s recorded, got {settings.step:g} s; shorten it")
    recordings, stuck = _examined(plant, recordings, settings.trusted)
    holdouts, _ = _examined(plant, holdouts, settings.trusted)
    offered = {p.prefix for p in library}
    frozen = {s.sensor.name: s for s in stuck if s.for_good and f"{s.sensor.name}.sensor_stuck" in offered}
    plant = _with_sensors_that_read(plant, recordings, stuck)
    library = tuple(p for p in library if p.location in plant.locations())
    nominal_effects = [Placement(effect(p.effect), p.location, p.parameters) for p in plant.effects]
    recordings, strays = _without_strays(plant, nominal_effects, recordings, settings.step)
    holdouts, strays_held = _without_strays(plant, nominal_effects, holdouts, settings.step)
    told = limits_from_readings(plant, recordings, nominal_effects, library)
    nominal_effects += told
    told += [Placement(effect("sensor_stuck"), n, {"size": 1.0, "onset": s.start}) for n, s in frozen.items()]
    strays = _as_strays([s for s in stuck if s.sensor.name not in frozen]) + strays
    data, *held = (
        checked_data_set(plant, nominal_effects, r, settings.step) for r in (recordings, *((h,) for h in holdouts))
    )
    apart = (strays, strays_held)
    asked = settings.most, settings.named_only
    return DiagnosisProblem(library, tuple(recordings), told, data, tuple(held), *asked, apart)


def _without_strays(
    plant: PlantDescription, nominal_effects: Sequence[Placement], recordings: Sequence[Recording], step: float | None
) -> tuple[list[Recording], list[SensorOutliers]]:
    """The recordings, what strays in them masked, and that."""
    kept: list[Recording] = []
    found: list[SensorOutliers] = []
    columns = {s.name: s.column for s in plant.sensors}
    for recording in recordings:
        mask, own = (
            recording.mask,
            outliers_of(data_set_of(plant, nominal_effects, recording, step or _step(plant, recording))),
        )
        for strays in own:
            mask = without(mask, strays.each, recording.output_names.index(columns[strays.sensor]))
        kept.append(replace(recording, mask=mask) if own else recording)
        found += own
    return kept, found


def _examined(
    plant: PlantDescription, recordings: Sequence[Recording], trusted: bool
) -> tuple[list[Recording], list[StuckSegment]]:
    """The recordings without readings of sensors that are stuck, and these. Raises ValueError for one that is not
    what it seems."""
    found = [usable(plant, replace(r, trusted=r.trusted or trusted), effects=True) for r in recordings]
    return [f.recording for f in found], [s for f in found for s in f.stuck]


def _with_sensors_that_read(
    plant: PlantDescription, recordings: Sequence[Recording], stuck: Sequence[StuckSegment]
) -> PlantDescription:
    """The plant without sensors of which little is left beside what stood still.

    Raises ValueError where no sensor is left.
    """
    left = {
        s.sensor.name: sum(int(r.mask[:, r.output_names.index(s.sensor.column)].sum()) for r in recordings)
        for s in stuck
    }
    silent = {name for name, count in left.items() if count < LEAST}
    if not silent:
        return plant
    if len(silent) == len(plant.sensors):
        raise ValueError(
            f"{recordings[0].source}: expected a sensor that reads its level, got none: {', '.join(sorted(silent))} "
            "stand still throughout; check their wiring"
        )
    return without_sensors(plant, silent)


def _as_strays(stuck: Sequence[StuckSegment]) -> list[SensorOutliers]:
    """Readings that stood still for a while, or of a sensor that nothing else may be said of."""
    each: dict[str, list[Outlier]] = {}
    for s in stuck:
        each.setdefault(s.sensor.name, []).append(Outlier(slice(s.first, s.beyond), (s.start, s.stop), math.inf))
    return [SensorOutliers(name, "", tuple(own)) for name, own in each.items()]


def check_holdout_differs(holdout: Recording, recordings: Sequence[Recording]) -> None:
    """Raises ValueError where a hold-out is one of the recordings that are diagnosed."""
    same_file = bool(holdout.sha256) and any(_overlap(holdout, r) for r in recordings)
    if same_file or any(holdout is r for r in recordings):
        raise ValueError(
            f"{holdout.source}: expected a hold-out other than the recording, got the same data; what was used for the "
            "fits says nothing of how far the gap closes"
        )


def _overlap(a: Recording, b: Recording) -> bool:
    """Whether both are stretches of one file that have time in common."""
    return a.sha256 == b.sha256 and bool(a.time[0] < b.time[-1]) and bool(b.time[0] < a.time[-1])


def checked_data_set(
    plant: PlantDescription, nominal_effects: Sequence[Placement], recordings: Sequence[Recording], step: float | None
) -> DataSet:
    """The recordings on the grid of their simulation. step: s; None for the sampling interval of the first, or a whole
    part of it that is no longer than LONGEST_STEP.
    """
    data = data_set_of(plant, nominal_effects, recordings, step or _step(plant, recordings[0]))
    check_enough_readings(data)
    return data


def _step(plant: PlantDescription, recording: Recording) -> float:
    """A whole part of the sampling interval, s."""
    interval = recording.interval
    return interval / math.ceil(interval / (LONGEST_STEP * time_scale(plant)) - 1e-9)


def check_enough_readings(data: DataSet) -> None:
    """Raises ValueError where a sensor has too few readings."""
    recording, plant = data.recording, data.plant
    for sensor, count in zip(plant.sensors, data.mask.sum(dim=0).tolist(), strict=True):
        if count < LEAST:
            raise ValueError(
                f"{recording.source}: expected at least {LEAST} readings of every sensor, got {count} of "
                f"{sensor.name}; record longer or more often, or leave the sensor out of the plant file"
            )
