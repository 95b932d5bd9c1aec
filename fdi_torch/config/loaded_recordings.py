"""Loading of recordings as the plant's inputs and outputs."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from fdi_torch.config.channels import (
    channel_mapping,
    expect_columns,
    expect_units,
    is_log,
    unrecorded_valves,
    without_column,
)
from fdi_torch.config.plant_file import AnyPlant, chosen_plant
from fdi_torch.config.problems import ConfigError, Source, naming, validated
from fdi_torch.config.recording_config import (
    ColumnConfig,
    FileConfig,
    RecordingConfig,
    StartLevel,
    config_of,
    in_seconds,
)
from fdi_torch.config.yaml_files import YAML_ENDINGS, expect_kind, find_data, find_file, read_extended
from fdi_torch.logbook import LogError
from fdi_torch.names import nearest, unknown
from fdi_torch.plant.description import PlantDescription
from fdi_torch.quantities import display_in, displayed_units, quantity_text
from fdi_torch.recording import Recording
from fdi_torch.recordings.csv_files import read_csv_files
from fdi_torch.recordings.database import is_query, write_query
from fdi_torch.recordings.mcap_files import read_mcap
from fdi_torch.recordings.source import ChannelSource, FileSource, TagRows


@dataclass(frozen=True)
class LoadedRecording:
    """A segment of a recording with all inputs known, and what is known of each tank's initial level."""

    recording: Recording
    start_levels: dict[str, StartLevel]


def load_recordings(
    configs: Sequence[RecordingConfig], plant: PlantDescription, base: Path | None = None
) -> list[LoadedRecording]:
    """All recordings, cut into segments with known inputs."""
    segments = []
    for k, config in enumerate(configs):
        expect_file(config, f"recordings.{k}", base)
        whole = read_recording(config, plant, base)
        segments += known_segments_of(whole, config, plant)
    return segments


def expect_file(config: RecordingConfig, place: str, base: Path | None = None) -> None:
    """Raises ConfigError, naming the place of the entry, if its file is missing."""
    if config.in_memory is None and not is_query(config.file):
        with naming(f"{place}.file"):
            find_data(config.file, base or Path.cwd())


def known_segments_of(whole: Recording, config: RecordingConfig, plant: PlantDescription) -> list[LoadedRecording]:
    """The segments of a recording in which all inputs are known; initial levels of later segments are free."""
    segments = [part for part in whole.known_segments() if len(part) > 1]
    if not segments:
        raise ConfigError([f"{whole.source}: expected a segment with all inputs known, got none: {_unknown(whole)}"])
    first = float(whole.time[0])
    levels = [config.start_levels if float(part.time[0]) == first else "free" for part in segments]
    return [
        LoadedRecording(part, start_levels_of(level, plant, config))
        for part, level in zip(segments, levels, strict=True)
    ]


def _unknown(whole: Recording) -> str:
    """How many values of each input are unknown, and advice."""
    counts = torch.isnan(whole.inputs).sum(dim=0).tolist()
    units = dict(zip(whole.input_names, whole.input_units, strict=True))
    unknown_counts = {name: count for name, count in zip(whole.input_names, counts, strict=True) if count}
    listing = ", ".join(f"{name} at {count} of {len(whole)} samples" for name, count in unknown_counts.items())
    partly_known = next((name for name, count in unknown_counts.items() if count < len(whole)), "")
    never_known = next((name for name in unknown_counts if unknown_counts[name] == len(whole)), partly_known)
    zero = quantity_text(0.0, units[never_known], name=never_known)
    fix = (
        f"if an input keeps its value over empty cells, give the time: columns: {{{partly_known}: {{held: 10 s}}}}, or "
        "held: always for one that is recorded on change; if it was not recorded, "
    )
    constant = f"give it a constant, as in columns: {{{never_known}: {{constant: {zero}}}}}"
    return f"unknown are {listing}; " + (fix if partly_known else "") + constant


def named_recordings(name: str, plant: PlantDescription, base: Path) -> list[Recording]:
    """The recordings of a command line's argument (see `listed_recordings`), in segments with known inputs."""
    configs, folder = listed_recordings(name, plant, base)
    return [part.recording for part in load_recordings(configs, plant, folder)]


def planned_recordings(name: str, plant: PlantDescription, base: Path) -> list[Recording]:
    """As `named_recordings`, of planned inputs: a sensor without a column counts as not recorded."""
    sensors = plant.outputs()
    configs, folder = listed_recordings(name, plant, base, optional=sensors)
    planned = []
    for config in configs:
        read = [] if is_query(config.file) else without_column(find_data(config.file, folder), sensors, config)
        unrecorded = {sensor: ColumnConfig(recorded=False) for sensor in read if sensor not in config.columns}
        planned.append(config.model_copy(update={"columns": config.columns | unrecorded}))
    return [part.recording for part in load_recordings(planned, plant, folder)]


def listed_recordings(
    name: str, plant: PlantDescription, base: Path, optional: Collection[str] = ()
) -> tuple[list[RecordingConfig], Path]:
    """The entries of a command line's argument, and the folder of their relative paths.

    name: a CSV or MCAP file, or a YAML file with a list under `recordings`, as in a run file. optional: channels that
    the file may lack.
    """
    if is_query(name):
        return [config_of(name)], base
    if Path(name).suffix not in YAML_ENDINGS:
        expect_columns(name, base, plant, optional)
        return [config_of(name)], base
    path = find_file(name, base)
    data = read_extended(path)
    listed = data.get("recordings")
    if not listed:
        expect_kind(data, "run", path, "a recording or a file with the key recordings")
        near = nearest("recordings", [key for key in data if key != "recordings"])
        raise ConfigError([f"{path}: recordings: expected at least one, got none; list files under it{near}"])
    return [validated(RecordingConfig, entry, Source(f"{path}: recordings")) for entry in listed], path.parent


def read_recording(
    config: RecordingConfig | Recording | Mapping[str, Any] | str | Path, plant: AnyPlant, base: Path | None = None
) -> Recording:
    """The plant's inputs and outputs in a recording, cropped, masked and decimated; unknown inputs are NaN.

    From now on quantities are displayed in the units of the plant, and the channels in those of the file.
    config: the name of the file, or the recording's entry in a run file: {"file": "run.xlsx", "columns": {"h1":
    {"column": "LT-101", "unit": "mm"}}}; or a recording in memory. plant: or the name of its file. base: folder of
    relative paths. The result is on the CPU. Raises ConfigError naming file, row and column.
    """
    if not isinstance(config, RecordingConfig):
        config = config_of(config)
    plant = chosen_plant(plant)
    folder = base or Path.cwd()
    try:
        if config.in_memory is not None:
            recording = config.in_memory.to(torch.device("cpu")).selected(plant.channels(), plant.outputs())
        elif is_query(config.file):
            with _as_file(config.file) as path:  # its hash is that of the table
                write_query(config.file, path, lambda name: find_data(name, folder))
                recording = replace(_read(config, path, folder, plant), source=config.file)
        else:
            recording = _read(config, find_data(config.file, folder), folder, plant)
        names = (*recording.input_names, *recording.output_names)
        expect_units(recording.source, names, (*recording.input_units, *recording.output_units), plant)
        start = -math.inf if config.start is None else in_seconds(config.start, recording, config)
        stop = math.inf if config.stop is None else in_seconds(config.stop, recording, config)
        masks = [(in_seconds(a, recording, config), in_seconds(b, recording, config)) for a, b in config.mask]
        selected = recording.window(start, stop).masked(masks).every(config.every)
        display_in({**displayed_units(), **recording.written})
        return replace(selected, trusted=config.trusted or selected.trusted)
    except (ValueError, LogError) as error:
        raise ConfigError([str(error)]) from None


def read_frame(frame: Any, plant: AnyPlant, **keys: Any) -> Recording:
    """The plant's inputs and outputs in a pandas.DataFrame, by the rules of CSV files.

    Columns have headers as in a CSV file (`h1_cm`, `h1 [cm]`), or the names of the plant's channels with their units in
    `frame.attrs["units"]`, as `Recording.to_pandas` returns them. Time is the index if it has a name, else a column.
    keys: further keys of the entry under `recordings:` in a run file, such as columns={"h1": {"column": "LT1", "unit":
    "mm"}}. An index of time stamps needs no name. Raises ConfigError naming row and column, TypeError for no frame.
    """
    if not hasattr(frame, "to_csv"):
        kind = type(frame).__name__
        raise TypeError(f"expected a pandas.DataFrame, got a {kind}; make one by pandas.DataFrame(...)")
    if frame.index.name is None and frame.index.dtype.kind == "M":
        frame = frame.rename_axis(index="t")
    units = frame.attrs.get("units", {})

    def header(name: Any) -> Any:
        return f"{name} [{units[name]}]" if name in units else name

    timed = frame.index.name is not None
    named = frame.rename(columns=header)
    named = named.rename_axis(index=header(frame.index.name)) if timed else named
    with _as_file("data frame") as path:
        named.to_csv(path, index=timed)
        config = validated(RecordingConfig, {"file": str(path), **keys}, Source("data frame"))
        return replace(read_recording(config, plant), source="data frame", sha256="")


@contextmanager
def _as_file(name: str) -> Iterator[Path]:
    """A path for a table that is not a file; errors call it by its name."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "table.csv"
        try:
            yield path
        except ConfigError as error:
            raise ConfigError([problem.replace(str(path), name) for problem in error.problems]) from None
        except (ValueError, ImportError) as error:
            raise ValueError(str(error).replace(str(path), name)) from None


def _read(config: RecordingConfig, path: Path, base: Path, plant: PlantDescription) -> Recording:
    """Read by the file's ending: an MCAP log (also an incomplete one), else CSV or another table."""
    mapping, inputs, outputs = channel_mapping(config, plant), plant.channels(), plant.outputs()
    if is_log(path):
        if config.also or config.tags or config.sheet or not config.header:
            raise ValueError(
                f"{config.file}: expected neither also, tags, sheet nor header beside an MCAP file; remove them"
            )
        return read_mcap(path, inputs, outputs, mapping, config.hold)
    files = [_source(config, path, mapping)]
    files += [_source(each, find_data(each.file, base), channel_mapping(each, plant)) for each in config.also]
    if not config.also and not config.tags:
        valves = unrecorded_valves(path, plant, config)
        files = [replace(files[0], columns=valves | mapping)]
    return read_csv_files(files, inputs, outputs, config.hold)


def _source(config: FileConfig, path: Path, mapping: Mapping[str, ChannelSource]) -> FileSource:
    if is_log(path):
        raise ValueError(f"{config.file}: expected a CSV file beside others, got an MCAP file")
    tags = config.tags
    rows = None if tags is None else TagRows(tags.tag, tags.value, tags.quality)
    if rows is not None and not config.header:
        raise ValueError(f"{config.file}: expected a header where rows have tags, got header: false; leave it out")
    return FileSource(path, mapping, rows, config.header, config.sheet)


def start_levels_of(start_levels: Any, plant: PlantDescription, config: RecordingConfig) -> dict[str, StartLevel]:
    """The start level of each tank; tanks that are not mentioned are free."""
    tanks = [tank.name for tank in plant.tanks]
    if not isinstance(start_levels, dict):
        return dict.fromkeys(tanks, start_levels)
    for name in start_levels:
        if name not in tanks:
            raise ConfigError([f"{config.file}: start_levels.{name}: {unknown('a tank', name, tanks)}"])
    return {tank: start_levels.get(tank, "free") for tank in tanks}
