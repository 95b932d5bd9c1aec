"""Recordings that another program is still writing, as CSV or MCAP: their samples as they arrive."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from fdi_torch.config.channels import channel_mapping, expect_units, is_log
from fdi_torch.config.problems import ConfigError
from fdi_torch.config.recording_config import ColumnConfig, RecordingConfig
from fdi_torch.config.yaml_files import find_data
from fdi_torch.live.row_buffer import Row, RowSource
from fdi_torch.logbook import LogError, Message, follow, number_at
from fdi_torch.plant.description import PlantDescription
from fdi_torch.quantities import si_unit_of, unit_factor
from fdi_torch.recordings.csv_growing import GrowingCsv
from fdi_torch.recordings.mcap_files import expect_keys_of_logs
from fdi_torch.recordings.source import ChannelSource

POLL = 0.1  # s


def growing_rows(
    config: RecordingConfig, plant: PlantDescription, base: Path, idle: float, origin: float | None = None
) -> RowSource:
    """Samples in the order of writing, and a sentence for each row that cannot be read. The file is opened at once.

    Ends when the file is finished, or when nothing has arrived for `idle` s. The origin is as the file's clock shows
    it; origin: that of an earlier run that is resumed. Raises ConfigError for an unusable file.
    """
    clock = config.columns.get("t", ColumnConfig())
    stamped = isinstance(config.start, datetime) or isinstance(config.stop, datetime)
    for unusable, problem in (
        (config.mask or config.every != 1, "expected neither mask nor every for a file that is followed; remove them"),
        (config.also or config.tags, "expected one row for each time in a file that is followed; remove also and tags"),
        (config.sheet or not config.header, "expected a CSV file with a header to follow; remove sheet and header"),
        (
            clock.zone or clock.sort or clock.period,
            "expected neither zone, sort nor period to follow a file; remove them",
        ),
        (stamped, "expected start and stop in s for a file that is followed, got a time stamp"),
    ):
        if unusable:
            raise ConfigError([f"{config.file}: {problem}"])
    path, inputs, outputs = _find(config.file, base), plant.channels(), plant.outputs()
    try:
        mapping = channel_mapping(config, plant)
        if is_log(path):
            return RowSource(_between(_mcap_rows(path, plant, mapping, idle), config.start, config.stop), lambda: None)
        file = GrowingCsv(path, inputs, outputs, mapping, origin)
        expect_units(str(path), (*inputs, *outputs), (*file.input_units, *file.output_units), plant)
    except (ValueError, LogError) as error:
        raise ConfigError([str(error)]) from None
    return RowSource(_between(_csv_rows(file, idle), config.start, config.stop), lambda: file.clock_zero)


def _between(rows: Iterator[Row | str], start: Any, stop: Any) -> Iterator[Row | str]:
    """The rows from start to stop, s, as far as these are given, and all sentences."""
    try:
        for row in rows:
            if isinstance(row, str) or ((start is None or start <= row[0]) and (stop is None or row[0] <= stop)):
                yield row
    except (ValueError, LogError) as error:
        raise ConfigError([str(error)]) from None


def _find(name: str, base: Path) -> Path:
    """The file, or its name with .partial, which it has while it is written."""
    try:
        return find_data(name, base)
    except ConfigError:
        if not name.endswith(".mcap"):
            raise
        return find_data(f"{name}.partial", base)


def _csv_rows(file: GrowingCsv, idle: float) -> Iterator[Row | str]:
    quiet_since = time.monotonic()
    while time.monotonic() - quiet_since <= idle:
        seconds, commands, readings, problems = file.new()
        rows = list(zip(seconds.tolist(), commands.tolist(), readings.tolist(), strict=True))
        first = 0
        for count, problem in problems:
            yield from rows[first:count]
            yield f"{problem}; the row is left out"
            first = count
        yield from rows[first:]
        if len(seconds):
            quiet_since = time.monotonic()
        else:
            time.sleep(POLL)


def _mcap_rows(
    path: Path, plant: PlantDescription, mapping: Mapping[str, ChannelSource], idle: float
) -> Iterator[Row | str]:
    """Messages grouped by time: inputs are held, a missing reading is NaN."""
    expect_keys_of_logs(path, mapping)
    sources = {name: mapping.get(name, ChannelSource()) for name in (*plant.channels(), *plant.outputs())}
    inputs = {n: math.nan if (value := sources[n].constant) is None else value for n in plant.channels()}
    readings = dict.fromkeys(plant.outputs(), math.nan)
    places = {n: _place(n, source, n in inputs) for n, source in sources.items() if source.constant is None}
    clock = mapping.get("t", ChannelSource())
    scale = unit_factor(clock.unit, "s") if clock.unit else 1.0
    factors: dict[str, float] = {}
    problems: list[str] = []
    now: float | None = None

    def finished() -> Iterator[Row]:
        if now is not None and any(map(math.isfinite, readings.values())):
            yield now, [*inputs.values()], [*readings.values()]

    topics = {topic for topic, _ in places.values()}
    for message in follow(path, topics, idle, POLL, lambda damage: problems.append(str(damage))):
        yield from problems
        problems.clear()
        payload = message.payload
        t = number_at(payload, clock.column or "t") * scale
        t = message.t if math.isnan(t) else t
        if t != now:
            yield from finished()
            readings |= dict.fromkeys(readings, math.nan)
        now = t
        for name, (topic, field) in places.items():
            if topic == message.topic:
                factor = factors.setdefault(name, _factor(message, name, field, sources[name], plant))
                value = number_at(payload, field) * factor
                values = inputs if name in inputs else readings
                values[name] = math.nan if field in payload.get("masked", ()) else value
    yield from finished()


def _place(name: str, source: ChannelSource, is_input: bool) -> tuple[str, str]:
    """Topic and field of a channel: as mapped, or as in logs of this program."""
    topic, _, field = (source.column or "").rpartition(":")
    return (topic, field) if topic else ("/plant/input" if is_input else "/plant/output", source.column or name)


def _factor(message: Message, name: str, field: str, source: ChannelSource, plant: PlantDescription) -> float:
    """Factor from the numbers of a message to SI. Raises ValueError for a missing unit or one of another dimension."""
    unit = source.unit or message.channel.units.get(field, "")
    if not unit:
        raise ValueError(f"{message.topic}: {name}: expected a unit, got none; give it under columns: {name}")
    expect_units(message.topic, (name,), (si_unit_of(unit),), plant)
    return unit_factor(unit, si_unit_of(unit))
