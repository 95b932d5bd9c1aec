"""The problem of a diagnosis, checked before any fit: what cannot be diagnosed raises an error of one sentence."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch

from fdi_torch.effects import effects_of
from fdi_torch.effects.stuck import Stuck
from fdi_torch.gap.accurate_steps import with_accurate_steps
from fdi_torch.gap.dataset import DataSet, data_set_of
from fdi_torch.gap.library import library_of
from fdi_torch.gap.preprocess.acquisition import CheckedRecording, StuckSegment, usable, without_sensors
from fdi_torch.gap.preprocess.outliers import Outlier, SensorOutliers, outliers_of, without
from fdi_torch.gap.preprocess.sensor_limits import limits_from_readings
from fdi_torch.gap.structure_search import MAX_EFFECTS
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.scales import time_scale
from fdi_torch.recording import Recording
from fdi_torch.recordings.plant_limits import with_rims_unknown
from fdi_torch.simulate.step_length import commensurate_step

MIN_READINGS = 60
"""Fewest readings of a sensor; with fewer, noise cannot be separated from a model error. Two of the slowest periods
that count as noise."""

# Range of integration steps, in units of the plant's time scale. The shortest is a quarter of the shortest period and
# lag that an effect describes; with steps longer than the longest, fits that meet a rim depend on their start.
SHORTEST_STEP, LONGEST_STEP = 0.5, 2.5
MANY_STEPS = 1_500
"""Steps beyond which longer ones are taken, up to the longest. It limits computing time and memory, which grow with the
number of steps; long recordings determine lags and periods well in any case."""

RELIABLE_BITS = 30
"""Bits of a reading that count, of its 53. No converter has more than 24, nor has a file of single precision."""


@dataclass(frozen=True)
class Settings:
    """library, leave_out: as in `library_of`. step: of the simulation, s; None chooses it (`checked_data_set`).

    most: effects in one explanation. named_only: report the best set of named effects, however much it leaves
    unexplained, as an intermediate step if many causes act together. trusted: as in `Recording`, for all of them.
    """

    library: tuple[str, ...] | None = None
    leave_out: tuple[str, ...] = ()
    step: float | None = None
    most: int = MAX_EFFECTS
    named_only: bool = False
    trusted: bool = False

    def __post_init__(self) -> None:
        if self.most < 1:
            raise ValueError(f"most: expected at least one effect, got {self.most}")
        if self.step is not None and not self.step > 0.0:
            raise ValueError(f"step: expected a positive number of seconds, got {self.step:g}")


DEFAULT_SETTINGS = Settings()


@dataclass(frozen=True)
class DiagnosisProblem:
    """library: the effects to search. known_effects: limits of sensors, and stuck sensors, that the readings show
    without a model. data: the recordings, for the plant with these effects and without sensors that are stuck
    throughout. holdouts: the hold-outs, likewise. outliers: masked readings of the recordings, and of the hold-outs.
    remarks: on what was changed in the plant. checks: of the recordings."""

    library: tuple[Placement, ...]
    recordings: tuple[Recording, ...]
    known_effects: list[Placement]
    data: DataSet
    holdouts: tuple[DataSet, ...]
    settings: Settings
    outliers: tuple[Sequence[SensorOutliers], Sequence[SensorOutliers]]
    remarks: Sequence[str]
    checks: Sequence[CheckedRecording]


def problem_of(
    plant: PlantDescription, recordings: Sequence[Recording], holdouts: Sequence[Recording], settings: Settings
) -> DiagnosisProblem:
    """Check the recordings and put their readings on the time grid of the simulation.

    Raises ValueError for unknown effects or places, missing sensors or inputs, too few readings, and a hold-out that is
    one of the recordings.
    """
    for one in holdouts:
        check_holdout_differs(one, recordings)
    library = library_of(plant, settings.library, settings.leave_out)
    longest = max(float(r.time[-1] - r.time[0]) for r in recordings)
    if settings.step is not None and settings.step > longest:
        raise ValueError(f"step: expected one within the {longest:g} s recorded, got {settings.step:g} s; shorten it")
    checks = _examined(plant, recordings, settings.trusted)
    checks_of_holdouts = _examined(plant, holdouts, settings.trusted)
    recordings, stuck = [c.recording for c in checks], [s for c in checks for s in c.stuck]
    holdouts = [c.recording for c in checks_of_holdouts]
    plant = with_rims_unknown(plant, [*recordings, *holdouts])
    freezing = {p.location: p for p in library if isinstance(p.effect, Stuck)}
    stuck_for_good = {s.sensor.name: s for s in stuck if s.for_good and s.sensor.name in freezing}
    plant = _without_stuck_sensors(plant, recordings, stuck)
    _check_readings(plant, recordings)
    library = tuple(p for p in library if p.location in plant.locations())
    nominal_effects = effects_of(plant)
    recordings, outliers = _without_outliers(plant, nominal_effects, recordings, settings.step)
    holdouts, holdout_outliers = _without_outliers(plant, nominal_effects, holdouts, settings.step)
    known_effects = limits_from_readings(plant, recordings, nominal_effects, library)
    nominal_effects += known_effects
    known_effects += [replace(freezing[n], values={"size": 1.0, "onset": s.onset}) for n, s in stuck_for_good.items()]
    outliers = _as_outliers([s for s in stuck if s.sensor.name not in stuck_for_good]) + outliers
    data, *holdout_data = (
        checked_data_set(plant, nominal_effects, r, settings.step) for r in (recordings, *((h,) for h in holdouts))
    )
    masked = outliers, holdout_outliers
    return DiagnosisProblem(
        library,
        tuple(recordings),
        known_effects,
        data,
        tuple(holdout_data),
        settings,
        masked,
        [c.fault.text for c in (*checks, *checks_of_holdouts) if c.fault],
        checks,
    )


def _without_outliers(
    plant: PlantDescription, nominal_effects: Sequence[Placement], recordings: Sequence[Recording], step: float | None
) -> tuple[list[Recording], list[SensorOutliers]]:
    """The recordings with outliers masked, and these outliers."""
    masked: list[Recording] = []
    all_outliers: list[SensorOutliers] = []
    columns = {s.name: s.column for s in plant.sensors}
    for recording in recordings:
        lay_out = partial(_laid_out, plant, nominal_effects, step=step)
        mask, of_recording = recording.mask, outliers_of(recording, lay_out)
        for of_sensor in of_recording:
            mask = without(mask, of_sensor.each, recording.output_names.index(columns[of_sensor.sensor]))
        masked.append(replace(recording, mask=mask) if of_recording else recording)
        all_outliers += of_recording
    return masked, all_outliers


def _examined(plant: PlantDescription, recordings: Sequence[Recording], trusted: bool) -> list[CheckedRecording]:
    """The recordings without readings of stuck sensors, when each of these is stuck, and what else looks wrong.

    Raises ValueError for a faulty recording.
    """
    return [
        usable(plant, replace(_without_rounding_errors(r), trusted=r.trusted or trusted), effects=True)
        for r in recordings
    ]


def _without_rounding_errors(recording: Recording) -> Recording:
    """The recording with readings rounded to RELIABLE_BITS.

    The last bits depend on the unit in which a file holds a reading. Equal readings, which show a limit, a stuck sensor
    or rounding, shall be equal in every unit.
    """
    largest = recording.outputs.nan_to_num().abs().amax(dim=0)
    step = torch.exp2(torch.floor(torch.log2(largest.clamp(min=torch.finfo(largest.dtype).tiny))) - RELIABLE_BITS)
    return replace(recording, outputs=(recording.outputs / step).round() * step)


def _without_stuck_sensors(
    plant: PlantDescription, recordings: Sequence[Recording], stuck: Sequence[StuckSegment]
) -> PlantDescription:
    """The plant without sensors that have too few readings besides those that are stuck.

    Raises ValueError if no sensor is left.
    """
    remaining = {
        s.sensor.name: sum(int(r.mask[:, r.output_names.index(s.sensor.column)].sum()) for r in recordings)
        for s in stuck
    }
    silent = {name for name, count in remaining.items() if count < MIN_READINGS}
    if not silent:
        return plant
    if len(silent) == len(plant.sensors):
        raise ValueError(
            f"{recordings[0].source}: expected a sensor whose readings vary, got none: {', '.join(sorted(silent))} "
            "repeat one value throughout; check their wiring"
        )
    return without_sensors(plant, silent)


def _check_readings(plant: PlantDescription, recordings: Sequence[Recording]) -> None:
    """Raises ValueError if a sensor has too few readings, or if no sensor's readings vary."""
    source, constant = recordings[0].source, []
    for sensor in plant.sensors:
        columns = [(r, r.output_names.index(sensor.column)) for r in recordings if sensor.column in r.output_names]
        readings = [r.outputs[r.mask[:, i], i] for r, i in columns]
        if columns:
            _expect_enough(source, sensor.name, sum(map(len, readings)))
            constant.append(len(torch.cat(readings).unique()) == 1)
    if constant and all(constant):
        raise ValueError(
            f"{source}: expected readings that vary, got one value of each sensor throughout, which does not show its "
            "noise; check the wiring, or record with inputs that change"
        )


def _expect_enough(source: str, sensor: str, count: int) -> None:
    if count < MIN_READINGS:
        raise ValueError(
            f"{source}: expected at least {MIN_READINGS} readings of every sensor, got {count} of {sensor}; record "
            "longer or more often, or leave the sensor out of the plant file"
        )


def _as_outliers(stuck: Sequence[StuckSegment]) -> list[SensorOutliers]:
    """Segments in which a sensor is stuck for some time, as outliers of that sensor."""
    by_sensor: dict[str, list[Outlier]] = {}
    for s in stuck:
        by_sensor.setdefault(s.sensor.name, []).append(Outlier(slice(s.first, s.beyond), (s.start, s.stop), math.inf))
    return [SensorOutliers(name, "", tuple(segments)) for name, segments in by_sensor.items()]


def check_holdout_differs(holdout: Recording, recordings: Sequence[Recording]) -> None:
    """Raises ValueError if a hold-out is one of the recordings that are diagnosed."""
    if any(_same_data(holdout, r) for r in recordings):
        raise ValueError(
            f"{holdout.source}: expected a hold-out other than the recording, got the same data; what was used for the "
            "fits says nothing of how far the gap closes"
        )


def _same_data(a: Recording, b: Recording) -> bool:
    """Whether both have the same readings, or are cut from one file and overlap in time."""
    overlap = bool(a.time[0] < b.time[-1]) and bool(b.time[0] < a.time[-1])
    readings = (x.outputs.nan_to_num() for x in (a, b))
    return (overlap and a.sha256 == b.sha256 != "") or (torch.equal(a.time, b.time) and torch.equal(*readings))


def checked_data_set(
    plant: PlantDescription, nominal_effects: Sequence[Placement], recordings: Sequence[Recording], step: float | None
) -> DataSet:
    """Lay the recordings out on the grid of their simulation, with the mean of the readings in each step.

    step: length of the simulation's steps, s. None chooses it: the shortest sampling interval of the recordings, or a
    whole multiple or fraction of it, between SHORTEST_STEP and LONGEST_STEP and with about MANY_STEPS steps at most.
    Where such a step is not accurate enough, it is divided further.
    """
    data = _laid_out(plant, nominal_effects, recordings, step)
    for sensor, count in zip(plant.sensors, data.mask.sum(dim=0).tolist(), strict=True):
        _expect_enough(data.recording.source, sensor.name, count)
    return data


def _laid_out(
    plant: PlantDescription, nominal_effects: Sequence[Placement], recordings: Sequence[Recording], step: float | None
) -> DataSet:
    """The data set in steps of `step` s, which is kept if given; by default in accurate ones."""
    data = data_set_of(plant, nominal_effects, recordings, step or _step(plant, recordings), averaged=True)
    return with_accurate_steps(data) if step is None else data


def _step(plant: PlantDescription, recordings: Sequence[Recording]) -> float:
    """A whole multiple, or a whole fraction, of the sampling interval, s."""
    interval, scale = min(recording.interval for recording in recordings), time_scale(plant)
    duration = sum(float(r.time[-1] - r.time[0]) for r in recordings)
    shortest = max(interval, SHORTEST_STEP * scale, duration / MANY_STEPS)
    return commensurate_step(min(shortest, LONGEST_STEP * scale), interval)
