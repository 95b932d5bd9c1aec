"""Recordings that another program is still writing, as CSV or MCAP: their samples as they arrive."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from datetime import datetime
from pathlib import Path

import numpy as np

from fdi_torch.config.channels import channel_mapping, expect_units
from fdi_torch.config.problems import ConfigError
from fdi_torch.config.recording_config import ColumnConfig, RecordingConfig
from fdi_torch.config.yaml_files import find_data
from fdi_torch.logbook import LogError, Message, follow, number_at
from fdi_torch.plant.description import PlantDescription
from fdi_torch.quantities import si_unit_of, unit_factor
from fdi_torch.recordings.csv_growing import GrowingCsv
from fdi_torch.recordings.mcap_files import expect_keys_of_logs
from fdi_torch.recordings.source import ChannelSource

POLL = 0.1  # s

Row = tuple[float, list[float], list[float]]
"""Time, s, the plant's inputs and its readings, SI; NaN for missing values."""


def growing_rows(
    config: RecordingConfig,
    plant: PlantDescription,
    base: Path,
    idle: float,
    began: Callable[[float], None] | None = None,
) -> Iterator[Row | str]:
    """Samples in the order of writing, and a sentence for each row that cannot be read. The file is opened at once.

    Ends when the file is finished, or when nothing has arrived for `idle` s. Raises ConfigError for an unusable file.
    began: called with time 0 as the file's clock shows it, s since 1970, if it has dates.
    """
    if config.mask or config.every != 1:
        raise ConfigError([f"{config.file}: expected neither mask nor every for a file that is followed; remove them"])
    if config.also or config.tags:
        raise ConfigError(
            [f"{config.file}: expected one row for each time in a file that is followed; remove also and tags"]
        )
    if config.sheet or not config.header:
        raise ConfigError([f"{config.file}: expected a CSV file with a header to follow; remove sheet and header"])
    clock = config.columns.get("t", ColumnConfig())
    if clock.zone or clock.sort or clock.period:
        raise ConfigError([f"{config.file}: expected neither zone, sort nor period to follow a file; remove them"])
    path = _find(config.file, base)
    if isinstance(config.start, datetime) or isinstance(config.stop, datetime):
        raise ConfigError(
            [f"{config.file}: expected start and stop in s for a file that is followed, got a time stamp"]
        )
    start = -np.inf if config.start is None else config.start
    stop = np.inf if config.stop is None else config.stop
    try:
        mapping = channel_mapping(config, plant)
        is_log = ".mcap" in path.suffixes
        rows = _mcap_rows(path, plant, mapping, idle) if is_log else _csv_rows(path, plant, mapping, idle, began)
    except (ValueError, LogError) as error:
        raise ConfigError([str(error)]) from None
    return _between(rows, start, stop)


def _between(rows: Iterator[Row | str], start: float, stop: float) -> Iterator[Row | str]:
    """The rows from start to stop, s, and all sentences."""
    try:
        for row in rows:
            if isinstance(row, str) or start <= row[0] <= stop:
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


def _csv_rows(
    path: Path,
    plant: PlantDescription,
    mapping: Mapping[str, ChannelSource],
    idle: float,
    began: Callable[[float], None] | None,
) -> Iterator[Row | str]:
    inputs, outputs = plant.channels(), plant.outputs()
    file = GrowingCsv(path, inputs, outputs, mapping)
    expect_units(str(path), (*inputs, *outputs), (*file.input_units, *file.output_units), plant)
    return _new_rows(file, idle, began)


def _new_rows(file: GrowingCsv, idle: float, began: Callable[[float], None] | None) -> Iterator[Row | str]:
    quiet_since = time.monotonic()
    while time.monotonic() - quiet_since <= idle:
        seconds, commands, readings, problems = file.new()
        if began is not None and len(seconds) and (zero := file.clock_zero) is not None:
            began(zero)
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
    inputs, outputs = plant.channels(), plant.outputs()
    sources = {name: mapping.get(name, ChannelSource()) for name in (*inputs, *outputs)}
    places = {n: _place(n, source, n in inputs) for n, source in sources.items() if source.constant is None}
    factors: dict[str, float] = {}
    constants = {name: sources[name].constant for name in inputs}
    inputs_now = {name: np.nan if value is None else value for name, value in constants.items()}
    clock = mapping.get("t", ChannelSource())
    scale = unit_factor(clock.unit, "s") if clock.unit else 1.0
    time_now, readings_now = None, dict.fromkeys(outputs, np.nan)
    problems: list[str] = []
    topics = {topic for topic, _ in places.values()}
    for message in follow(path, topics, idle, POLL, lambda damage: problems.append(str(damage))):
        yield from problems
        problems.clear()
        payload = message.payload
        t = number_at(payload, clock.column or "t") * scale
        t = message.t if np.isnan(t) else t
        if time_now is not None and t != time_now:
            if any(np.isfinite(list(readings_now.values()))):
                yield time_now, list(inputs_now.values()), list(readings_now.values())
            readings_now = dict.fromkeys(outputs, np.nan)
        time_now = t
        for name, (topic, field) in places.items():
            if topic == message.topic:
                value = number_at(payload, field)
                factor = factors.setdefault(name, _factor(message, name, field, mapping, plant))
                is_valid = field not in payload.get("masked", ())
                (inputs_now if name in inputs_now else readings_now)[name] = value * factor if is_valid else np.nan
    if time_now is not None and any(np.isfinite(list(readings_now.values()))):
        yield time_now, list(inputs_now.values()), list(readings_now.values())


def _place(name: str, source: ChannelSource, is_input: bool) -> tuple[str, str]:
    """Topic and field of a channel: as mapped, or as in logs of this program."""
    topic, _, field = (source.column or "").rpartition(":")
    return (topic, field) if topic else ("/plant/input" if is_input else "/plant/output", source.column or name)


def _factor(
    message: Message, name: str, field: str, mapping: Mapping[str, ChannelSource], plant: PlantDescription
) -> float:
    """Factor from the numbers of a message to SI. Raises ValueError for a missing unit or one of another dimension."""
    source = mapping.get(name, ChannelSource())
    unit = source.unit or message.channel.units.get(field, "")
    if not unit:
        raise ValueError(f"{message.topic}: {name}: expected a unit, got none; give it under columns: {name}")
    expect_units(message.topic, (name,), (si_unit_of(unit),), plant)
    return unit_factor(unit, si_unit_of(unit))
