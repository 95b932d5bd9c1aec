"""Checks of a recording before a diagnosis: stuck sensors are masked, faulty recordings are rejected.

A run of equal readings that noise and quantization cannot explain (`recordings/repeated_readings.py`) means that the
sensor is stuck, unless its value is the end of the sensor's range: there the reading may be clipped, if the predicted
level lies beyond that end. The commands check, gap, train and monitor all use these checks before they fit anything.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from statistics import median

import torch
from torch import Tensor

from fdi_torch.gap.candidate import Candidate
from fdi_torch.gap.preprocess.blockwise_likelihood import BlockwiseFit, blocked_recording, blockwise_fit, noise_of
from fdi_torch.gap.preprocess.recording_fault_decision import SURE, FaultSearch
from fdi_torch.gap.preprocess.recording_fault_texts import RecordingFault, not_held
from fdi_torch.plant.description import PlantDescription, Sensor, with_tolerances
from fdi_torch.quantities import quantity_text
from fdi_torch.recording import Recording
from fdi_torch.recordings.input_sampling import inputs_not_held
from fdi_torch.recordings.plant_limits import denied_rims, with_rims_unknown
from fdi_torch.recordings.plant_units import doubtful_units, excessive_flows, refusal, wrong_units
from fdi_torch.recordings.repeated_readings import Scatter, scatter, stuck_runs

FEWEST = 20
"""Fewest samples for these checks; fewer cannot give a probability of 95 %."""


@dataclass(frozen=True)
class StuckSegment:
    """A segment in which a sensor is stuck: rows first to beyond - 1, at `value`, from start to stop (s).

    for_good: whether the segment lasts until the end of the recording. onset: of the effect, s after the first sample.
    """

    sensor: Sensor
    first: int
    beyond: int
    value: float
    start: float
    stop: float
    for_good: bool
    onset: float

    @property
    def text(self) -> str:
        until = "on" if self.for_good else f"to {self.stop:g} s"
        value = quantity_text(self.value, self.sensor.unit, name=self.sensor.column)
        return f"{self.sensor.column} is stuck at {value} from {self.start:g} s {until}: these readings do not count"


@dataclass(frozen=True)
class CheckedRecording:
    """A recording whose stuck readings are masked. fault: a fault of the whole recording, or None. search: for faults
    of the recording in which none was found, or None if there was none.
    """

    recording: Recording
    stuck: tuple[StuckSegment, ...]
    fault: RecordingFault | None
    search: FaultSearch | None = None

    def thorough_finding(self, explanation: Candidate | None = None) -> str:
        """What is probably wrong with the recording beside an effect of the plant; empty if nothing is.

        explanation: effects of the plant that the diagnosis found, which a fault must surpass.
        """
        fault = self.fault or (self.search and self.search.fault(thorough=True, explanation=explanation))
        return fault.text if fault else ""


def examined(plant: PlantDescription, recording: Recording, thorough: bool = False) -> CheckedRecording:
    """Check a recording, whose inputs are known, for stuck sensors and recording faults.

    thorough: also for a recording fault beside an effect of the plant, which takes some seconds.
    """
    if not recording.trusted and (excessive := excessive_flows(plant, recording)):
        commands = tuple(channel for channel, _ in excessive)
        return CheckedRecording(recording, (), RecordingFault(commands, "; ".join(text for _, text in excessive)))
    plant = _with_recorded_sensors(plant, recording)
    if len(recording) < FEWEST or not plant.sensors:
        return CheckedRecording(recording, (), None)
    if not recording.trusted and (wrong := wrong_units(plant, recording)):
        return CheckedRecording(recording, (), RecordingFault(("units",), wrong))
    rims = [] if recording.trusted else denied_rims(plant, recording)
    if rims and (fault := _unit_above_rim(plant, recording, {rim.sensor.column for rim in rims})):
        return CheckedRecording(recording, (), fault)
    plant = with_rims_unknown(plant, [recording])
    stuck = _stuck(plant, recording)
    remaining, fault = without(recording, stuck), None
    # One value throughout may also be due to small noise, or to an end of the range.
    constant = [s for s in plant.sensors if len(remaining.valid_readings(s.column).unique()) == 1]
    search = None
    while not recording.trusted:
        search = FaultSearch(plant, remaining, tuple(s.column for s in constant))
        if not (fault := search.fault(thorough)):
            break
        silent = [s for s in constant if s.column in fault.channels]
        if not (fault.silent and silent):
            break
        stuck += [_segment(remaining, sensor) for sensor in silent]
        remaining, constant = without(recording, stuck), [s for s in constant if s not in silent]
    if not recording.trusted and fault is None and (channels := inputs_not_held(remaining, plant)):
        fault = not_held(channels, recording.interval)
    if fault is None and rims:
        columns = tuple(rim.sensor.column for rim in rims)
        fault = RecordingFault(columns, "; ".join(rim.text for rim in rims), physical=True)
    return CheckedRecording(_with_notes(remaining, stuck), tuple(stuck), fault, None if fault else search)


def thorough_findings(plant: PlantDescription, recordings: Iterable[Recording]) -> tuple[str, ...]:
    """What is probably wrong with recordings beside an effect of the plant, as `fdi check` says it."""
    faults = [examined(plant, recording, thorough=True).fault for recording in recordings]
    return tuple(dict.fromkeys(fault.text for fault in faults if fault))


def _unit_above_rim(plant: PlantDescription, recording: Recording, columns: set[str]) -> RecordingFault | None:
    """The wrong unit of a sensor that reads above its rim (one of the columns), by the volume balance.

    A sensor that follows its level badly could explain the balance as well, but not readings above the rim; a wrong rim
    in the plant file could explain those, but not the balance.
    """
    for names, text in doubtful_units(plant, recording):
        if not columns.isdisjoint(channels := tuple(names.split(", "))):
            return RecordingFault(channels, f"{names}: {text}")
    return None


def usable(plant: PlantDescription, recording: Recording, effects: bool = False) -> CheckedRecording:
    """Check a recording. Raises ValueError if it has a recording fault.

    effects: whether the caller considers effects of sensors; one that lags or leads is then accepted, and so are
    readings above a rim, which the caller must take as unknown (`with_rims_unknown`).
    """
    checked = examined(plant, recording)
    if checked.fault and not (effects and checked.fault.physical):
        raise ValueError(refusal(recording, checked.fault.text))
    return checked


def _stuck(plant: PlantDescription, recording: Recording) -> list[StuckSegment]:
    """Segments in which a sensor is stuck and not clipped."""
    segments = [each for sensor in plant.sensors for each in _segments(plant, recording, sensor)]
    unclear = [each for each in segments if _may_be_clipped(plant, recording, each)]
    stuck, remaining = [each for each in segments if each not in unclear], without(recording, segments)
    if ambiguous := [each for each in unclear if _other_readings(recording, each).numel()]:
        fitted = blockwise_fit(blocked_recording(plant, remaining, noise_of(plant, remaining)))
        stuck += [each for each in ambiguous if _level_inside_range(plant, recording, each, ambiguous, fitted)]
    return stuck


def without_sensors(plant: PlantDescription, names: Collection[str]) -> PlantDescription:
    """The plant without these sensors, their effects and their tolerances."""
    sensors = tuple(s for s in plant.sensors if s.name not in names)
    effects = tuple(e for e in plant.effects if e.location not in names)
    return with_tolerances(replace(plant, sensors=sensors, effects=effects), lambda name: name.place not in names)


def _with_recorded_sensors(plant: PlantDescription, recording: Recording) -> PlantDescription:
    """The plant with only those sensors that the recording contains."""
    return without_sensors(plant, {s.name for s in plant.sensors if s.column not in recording.output_names})


def _with_notes(recording: Recording, stuck: Sequence[StuckSegment]) -> Recording:
    """The recording with notes on its stuck segments."""
    notes = tuple(f"{recording.source}: {each.text}" for each in _longest_first(stuck))
    return replace(recording, notes=(*recording.notes, *notes))


MANY = 3
"""Maximum number of stuck segments reported per sensor, the longest ones."""


def _longest_first(stuck: Sequence[StuckSegment]) -> list[StuckSegment]:
    """The longest segments of each sensor, in the order of time."""
    kept = []
    for sensor in dict.fromkeys(each.sensor for each in stuck):
        segments = sorted((s for s in stuck if s.sensor is sensor), key=lambda s: s.first - s.beyond)
        kept += sorted(segments[:MANY], key=lambda s: s.first)
    return kept


def _segments(plant: PlantDescription, recording: Recording, sensor: Sensor) -> list[StuckSegment]:
    """Segments of repeated readings of one sensor."""
    values = recording.valid_readings(sensor.column)
    usual = _typical_scatter(plant, recording, sensor) if len(values.unique()) == 1 else None
    return [_segment(recording, sensor, *run) for run in stuck_runs(values, usual)]


def _segment(recording: Recording, sensor: Sensor, first: int = 0, beyond: int | None = None) -> StuckSegment:
    """A segment of some valid readings of a sensor, by default of all: from the `first` to before the one `beyond`."""
    column = recording.output_names.index(sensor.column)
    rows = recording.mask[:, column].nonzero().flatten()
    a, b = int(rows[first]), int(rows[first:beyond][-1])
    value, start, stop = (float(x) for x in (recording.outputs[a, column], recording.time[a], recording.time[b]))
    onset = start - float(recording.time[0])
    return StuckSegment(sensor, a, b + 1, value, start, stop, beyond in (None, len(rows)), onset)


def _typical_scatter(plant: PlantDescription, recording: Recording, sensor: Sensor) -> Scatter:
    """Median scatter of the other sensors with the same unit, rescaled to the gain of this sensor."""
    others = [s for s in plant.sensors if s is not sensor and s.unit == sensor.unit]
    scatters = [(scatter(recording.valid_readings(s.column)), abs(sensor.gain / s.gain)) for s in others]
    moving = [(each, scale) for each, scale in scatters if each.step > 0.0]
    if not moving:
        return Scatter(0.0, 0.0)
    return Scatter(median(s.noise * k for s, k in moving), median(s.step * k for s, k in moving))


def _other_readings(recording: Recording, stuck: StuckSegment) -> Tensor:
    """The sensor's valid readings that differ from the value at which it is stuck."""
    values = recording.valid_readings(stuck.sensor.column)
    return values[values != stuck.value]


def _may_be_clipped(plant: PlantDescription, recording: Recording, stuck: StuckSegment) -> bool:
    """Whether the readings may repeat one value because the sensor or the tank is at a limit, not because the sensor is
    stuck.

    That is possible if no other reading is above the value, or none below it. If the sensor has no other readings: if
    the value lies at a limit of the sensor, or at or beyond the floor or rim of the tank.
    """
    sensor, rest = stuck.sensor, _other_readings(recording, stuck)
    if len(rest):
        return not float(rest.min()) < stuck.value < float(rest.max())
    height = next(t.height for t in plant.tanks if t.name == sensor.tank)
    level = (stuck.value - sensor.offset) / sensor.gain
    return not 0.0 < level < height or stuck.value in (sensor.low, sensor.high)


def _level_inside_range(
    plant: PlantDescription,
    recording: Recording,
    stuck: StuckSegment,
    ambiguous: list[StuckSegment],
    fitted: BlockwiseFit,
) -> bool:
    """Whether the predicted level lies inside the range by more than the model error.

    All segments at this value count together. Log odds as in `blockwise_likelihood`, against a clipped reading.
    """
    i = plant.sensors.index(stuck.sensor)
    blocked, model = fitted.blocked, fitted.readings[:, i]
    time, stuck_now = blocked.recording.time, torch.zeros(len(model), dtype=torch.bool)
    for each in ambiguous:
        if each.sensor is stuck.sensor and each.value == stuck.value:
            stuck_now |= (time >= each.start) & (time <= each.stop)
    if not bool(stuck_now.any()):
        return False
    at_top = stuck.value >= float(_other_readings(recording, stuck).max())
    inside = (stuck.value - model if at_top else model - stuck.value).clamp(min=0.0)
    means, samples = blocked.means(inside.unsqueeze(1), stuck_now.unsqueeze(1))
    mean_square = float((samples * means**2).sum() / samples.sum())
    gains = torch.tensor([s.gain for s in plant.sensors], dtype=torch.float64)
    model_error = float(((fitted.variance / gains**2)[fitted.means > 0]).max()) * stuck.sensor.gain**2
    count = blocked.errors * float(stuck_now.double().mean())
    return 0.5 * count * math.log(max(mean_square, model_error) / model_error) > SURE


def without(recording: Recording, stuck: Sequence[StuckSegment]) -> Recording:
    """Mask these segments, including their first reading: that of a dead sensor is wrong as well."""
    mask = recording.mask.clone()
    for each in stuck:
        mask[each.first : each.beyond, recording.output_names.index(each.sensor.column)] = False
    return replace(recording, mask=mask)
