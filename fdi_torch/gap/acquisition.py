"""A recording as a diagnosis may use it: sensors that are stuck are masked and told; a recording whose units, channels
or clocks have slipped is refused. `fdi check`, `gap`, `train` and `monitor` all ask here, before they fit anything.

A run of equal readings that noise and rounding do not make (`recordings/repeated_readings.py`) is a sensor that is
stuck, unless its value ends the range of what it reads: there it may be clipped, as far as the plant's level lies
beyond.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from statistics import median

import torch
from torch import Tensor

from fdi_torch.gap.slip_evidence import Run, laid_out, noise_of, run, thinned
from fdi_torch.gap.slips import SURE, Slip, slip_of
from fdi_torch.parameters import display_unit
from fdi_torch.plant.description import PlantDescription, Sensor
from fdi_torch.recording import Recording
from fdi_torch.recordings.repeated_readings import Scatter, scatter, stuck_runs

FEWEST = 20
"""Samples below which nothing is told: they hold fewer means than it takes for odds of 95 %."""


@dataclass(frozen=True)
class Stuck:
    """Readings of a sensor that stood still: rows from first to beyond, at a value; from start to stop, s."""

    sensor: Sensor
    first: int
    beyond: int
    value: float
    start: float
    stop: float
    for_good: bool

    def column_in(self, recording: Recording) -> int:
        return _column(recording, self.sensor)

    @property
    def text(self) -> str:
        unit, scale = display_unit(self.sensor.unit)
        until = "on" if self.for_good else f"to {self.stop:g} s"
        return (
            f"{self.sensor.column} is stuck at {scale * self.value:.4g} {unit} from {self.start:g} s {until}: "
            "these readings do not count"
        )


@dataclass(frozen=True)
class Examined:
    """recording: without the readings that stood still. slip: what else is wrong with it, if anything."""

    recording: Recording
    stuck: tuple[Stuck, ...]
    slip: Slip | None


def examined(plant: PlantDescription, recording: Recording) -> Examined:
    """What is stuck, and what has slipped, in a recording whose inputs are known."""
    plant = _recorded(plant, recording)
    if len(recording) < FEWEST or not plant.sensors:
        return Examined(recording, (), None)
    stuck = list(stuck_in(plant, recording))
    sound, slip = without(recording, stuck), None
    still = _never_moving(plant, sound)
    while not recording.trusted and (slip := slip_of(plant, sound, tuple(s.column for s in still))):
        silent = [s for s in still if s.column in slip.channels]
        if not (slip.silent and silent):
            break
        stuck += _whole(sound, silent)
        sound, still = without(recording, stuck), [s for s in still if s not in silent]
    return Examined(_noted(sound, stuck), tuple(stuck), slip)


def usable(plant: PlantDescription, recording: Recording, effects: bool = False) -> Examined:
    """The same. Raises ValueError where something has slipped.

    effects: whether the caller considers effects of sensors: then one that reads late is left to it.
    """
    found = examined(plant, recording)
    if found.slip and not (effects and found.slip.physical):
        raise ValueError(
            f"{recording.source}: {found.slip.text}; where all is as it should be, say trusted: true beside the file"
        )
    return found


def stuck_in(plant: PlantDescription, recording: Recording) -> tuple[Stuck, ...]:
    """Stretches in which a sensor stands still and is not clipped."""
    plant = _recorded(plant, recording)
    if len(recording) < FEWEST or not plant.sensors:
        return ()
    runs = {s: _held(plant, recording, s) for s in plant.sensors}
    stuck = [each for found in runs.values() for each in found if not _may_be_clipped(plant, recording, each)]
    unclear = [each for found in runs.values() for each in found if each not in stuck]
    rest = without(recording, [*stuck, *unclear])
    if partly := [each for each in unclear if _rest(recording, each).numel()]:
        beside = run(laid_out(plant, thinned(rest), noise_of(plant, recording)))
        stuck += [each for each in partly if _not_clipped(plant, recording, each, partly, beside)]
    return tuple(stuck)


def without_sensors(plant: PlantDescription, names: Collection[str]) -> PlantDescription:
    """The plant without these sensors, and without what it believes of them."""
    return replace(
        plant,
        sensors=tuple(s for s in plant.sensors if s.name not in names),
        effects=tuple(e for e in plant.effects if e.location not in names),
        tolerances={n: v for n, v in plant.tolerances.items() if n.partition(".")[0] not in names},
        varying=tuple(n for n in plant.varying if n.partition(".")[0] not in names),
    )


def _recorded(plant: PlantDescription, recording: Recording) -> PlantDescription:
    """The plant with the sensors that the recording has."""
    return without_sensors(plant, {s.name for s in plant.sensors if s.column not in recording.output_names})


def _noted(recording: Recording, stuck: Sequence[Stuck]) -> Recording:
    notes = tuple(f"{recording.source}: {each.text}" for each in _longest_first(stuck))
    return replace(recording, notes=(*recording.notes, *notes))


MANY = 3
"""Stretches of one sensor that are told one by one."""


def _longest_first(stuck: Sequence[Stuck]) -> list[Stuck]:
    """The longest stretches of each sensor, in time."""
    kept = []
    for sensor in dict.fromkeys(each.sensor for each in stuck):
        own = sorted((s for s in stuck if s.sensor is sensor), key=lambda s: s.first - s.beyond)
        kept += sorted(own[:MANY], key=lambda s: s.first)
    return kept


def _column(recording: Recording, sensor: Sensor) -> int:
    return recording.output_names.index(sensor.column)


def _values(recording: Recording, sensor: Sensor) -> tuple[Tensor, Tensor]:
    """Rows that count, and what was read there."""
    column = _column(recording, sensor)
    rows = recording.mask[:, column].nonzero().flatten()
    return rows, recording.outputs[rows, column]


def _held(plant: PlantDescription, recording: Recording, sensor: Sensor) -> list[Stuck]:
    rows, values = _values(recording, sensor)
    usual = _usual(plant, recording, sensor) if len(values) and bool((values == values[0]).all()) else None
    time = recording.time
    return [
        Stuck(
            sensor,
            int(rows[first]),
            int(rows[beyond - 1]) + 1,
            float(values[first]),
            float(time[rows[first]]),
            float(time[rows[beyond - 1]]),
            beyond == len(values),
        )
        for first, beyond in stuck_runs(values, usual)
    ]


def _usual(plant: PlantDescription, recording: Recording, sensor: Sensor) -> Scatter:
    """The scatter of the other sensors of this kind, as this one would show it."""
    others = [s for s in plant.sensors if s is not sensor and s.unit == sensor.unit]
    found = [(scatter(_values(recording, s)[1]), abs(sensor.gain / s.gain)) for s in others]
    moving = [(each, scale) for each, scale in found if each.step > 0.0]
    if not moving:
        return Scatter(0.0, 0.0)
    return Scatter(median(s.noise * k for s, k in moving), median(s.step * k for s, k in moving))


def _rest(recording: Recording, stuck: Stuck) -> Tensor:
    """What the sensor reads elsewhere."""
    _, values = _values(recording, stuck.sensor)
    return values[values != stuck.value]


def _may_be_clipped(plant: PlantDescription, recording: Recording, stuck: Stuck) -> bool:
    """Whether its value ends the range of the sensor's readings, or of the tank where it never reads another."""
    sensor, rest = stuck.sensor, _rest(recording, stuck)
    if len(rest):
        return not float(rest.min()) < stuck.value < float(rest.max())
    height = next(t.height for t in plant.tanks if t.name == sensor.tank)
    level = (stuck.value - sensor.offset) / sensor.gain
    return not 0.0 < level < height or stuck.value in (sensor.low, sensor.high)


def _not_clipped(
    plant: PlantDescription, recording: Recording, stuck: Stuck, all_of_them: list[Stuck], beside: Run
) -> bool:
    """Whether the plant's level, by the other readings, lies inside of the range by more than the model is wrong.

    All stretches at that value count together: log odds as in `slip_evidence`, of a run in which the value is clipped.
    """
    i = plant.sensors.index(stuck.sensor)
    case, model = beside.case, beside.readings[:, i]
    time, held_now = case.recording.time, torch.zeros(len(model), dtype=torch.bool)
    for each in all_of_them:
        if each.sensor is stuck.sensor and each.value == stuck.value:
            held_now |= (time >= each.start) & (time <= each.stop)
    if not bool(held_now.any()):
        return False
    at_top = stuck.value >= float(_rest(recording, stuck).max())
    inside = (stuck.value - model if at_top else model - stuck.value).clamp(min=0.0)
    means, samples = case.means(inside.unsqueeze(1), held_now.unsqueeze(1))
    left = float((samples * means**2).sum() / samples.sum())
    gains = torch.tensor([s.gain for s in plant.sensors], dtype=torch.float64)
    wrong = float(((beside.variance / gains**2)[beside.means > 0]).max()) * stuck.sensor.gain**2
    count = case.blocks * float(held_now.double().mean())
    return 0.5 * count * math.log(max(left, wrong) / wrong) > math.log(SURE / (1.0 - SURE))


def _never_moving(plant: PlantDescription, recording: Recording) -> list[Sensor]:
    """Sensors that read one value alone, which noise as it is known may leave, or an end of the range."""
    found = []
    for sensor in plant.sensors:
        _, values = _values(recording, sensor)
        if len(values) and bool((values == values[0]).all()):
            found.append(sensor)
    return found


def _whole(recording: Recording, sensors: Sequence[Sensor]) -> list[Stuck]:
    stuck = []
    for sensor in sensors:
        rows, values = _values(recording, sensor)
        first, last = int(rows[0]), int(rows[-1])
        span = float(recording.time[first]), float(recording.time[last])
        stuck.append(Stuck(sensor, first, last + 1, float(values[0]), *span, True))
    return stuck


def without(recording: Recording, stuck: Sequence[Stuck]) -> Recording:
    """Without these readings. The first of each stretch goes too: a dead sensor's is as wrong as the rest."""
    mask = recording.mask.clone()
    for each in stuck:
        mask[each.first : each.beyond, each.column_in(recording)] = False
    return replace(recording, mask=mask)
