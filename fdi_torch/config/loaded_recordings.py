"""Reading the recordings that are meant, as the plant's inputs and outputs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from pydantic import ValidationError

from fdi_torch.config.channels import channel_mapping, expect_units, is_log, unrecorded_valves
from fdi_torch.config.files import find_data, find_file, read_extended
from fdi_torch.config.problems import ConfigError, explain
from fdi_torch.config.recordings import FileConfig, RecordingConfig, StartLevel, in_seconds
from fdi_torch.logbook import LogError
from fdi_torch.names import unknown
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording
from fdi_torch.recordings.csv_files import read_csv_files
from fdi_torch.recordings.mcap_files import read_mcap
from fdi_torch.recordings.source import ChannelSource, FileSource, TagRows

GIVE_A_CONSTANT = "give the unknown one a constant, as in columns: {Q1: {constant: 0 cm^3/s}}"


@dataclass(frozen=True)
class LoadedRecording:
    """A stretch of a recording whose inputs are all known, and what is known of each tank's level at its start."""

    recording: Recording
    start_levels: dict[str, StartLevel]


def load_recordings(
    configs: Sequence[RecordingConfig],
    plant: PlantDescription,
    base: Path | None = None,
    given: Mapping[str, Recording] | None = None,
) -> list[LoadedRecording]:
    """Every recording, cut where an input is unknown. given: as for `read_recording`."""
    parts = []
    for config in configs:
        whole = read_recording(config, plant, base, given)
        parts += known_parts(whole, config, plant)
    return parts


def known_parts(whole: Recording, config: RecordingConfig, plant: PlantDescription) -> list[LoadedRecording]:
    """A recording cut where an input is unknown; the levels at the start of a later stretch are free."""
    stretches = [part for part in whole.known_stretches() if len(part) > 1]
    if not stretches:
        raise ConfigError([f"{whole.source}: expected a stretch with all inputs known, got none: {_unknown(whole)}"])
    first = float(whole.time[0])
    starts = [config.start_levels if float(part.time[0]) == first else "free" for part in stretches]
    return [LoadedRecording(part, _levels(start, plant, config)) for part, start in zip(stretches, starts, strict=True)]


def _unknown(whole: Recording) -> str:
    """Which inputs are unknown and how often, and what to do about it."""
    shares = torch.isnan(whole.inputs).double().mean(dim=0).tolist()
    each = {name: share for name, share in zip(whole.input_names, shares, strict=True) if share > 0.0}
    told = ", ".join(f"{name} at {share:.3g} of the samples" for name, share in each.items())
    some = next((name for name, share in each.items() if share < 1.0), "")
    fix = f"where its last value stands for empty cells say for how long, as in columns: {{{some}: {{held: 10 s}}}}"
    return f"unknown are {told}; " + (f"{fix}, or {GIVE_A_CONSTANT}" if some else GIVE_A_CONSTANT)


def named_recordings(name: str, plant: PlantDescription, base: Path) -> list[Recording]:
    """What stands for recordings on a command line: a CSV or MCAP file, or a YAML file with a list under `recordings`,
    as in a run file; each in stretches whose inputs are known.
    """
    if Path(name).suffix not in (".yaml", ".yml"):
        return [part.recording for part in load_recordings([RecordingConfig(file=name)], plant, base)]
    path = find_file(name, base)
    listed = read_extended(path).get("recordings")
    if not listed:
        raise ConfigError([f"{path}: recordings: expected at least one, got none; list files under it"])
    try:
        configs = [RecordingConfig.model_validate(entry) for entry in listed]
    except ValidationError as error:
        raise explain(error, f"{path}: recordings") from None
    return [loaded.recording for loaded in load_recordings(configs, plant, path.parent)]


def named_apart(recordings: Sequence[Any]) -> tuple[list[Any], dict[str, Recording]]:
    """Recordings as a run file lists them, of which some may be `Recording`s themselves: these by a name each."""
    given: dict[str, Recording] = {}
    listed = []
    for each in recordings:
        if isinstance(each, Recording):
            name = each.source if each.source not in given else f"{each.source} ({len(given) + 1})"
            given[name] = each
            each = {"file": name}
        listed.append(each)
    return listed, given


def read_recording(
    config: RecordingConfig | str | Path,
    plant: PlantDescription,
    base: Path | None = None,
    given: Mapping[str, Recording] | None = None,
) -> Recording:
    """The plant's inputs and outputs: selected, masked and thinned, unknown inputs still in it (NaN).

    config: what a run file says of a recording, or the file's name alone. base: where paths start. given: recordings
    that are at hand and are not read, by what `file` calls them. Raises ConfigError naming file, row and column.
    """
    if not isinstance(config, RecordingConfig):
        config = RecordingConfig(file=str(config))
    channels, columns = plant.channels(), tuple(sensor.column for sensor in plant.sensors)
    at_hand = (given or {}).get(config.file)
    path = Path(config.file) if at_hand else find_data(config.file, base or Path.cwd())
    try:
        if at_hand is None:
            recording = _read(config, path, base or Path.cwd(), plant, channels, columns)
        else:
            recording = at_hand.selected(channels, columns)
        names = (*recording.input_names, *recording.output_names)
        expect_units(recording.source, names, (*recording.input_units, *recording.output_units), plant)
        start = -math.inf if config.start is None else in_seconds(config.start, recording, config)
        stop = math.inf if config.stop is None else in_seconds(config.stop, recording, config)
        masks = [(in_seconds(a, recording, config), in_seconds(b, recording, config)) for a, b in config.mask]
        selected = recording.window(start, stop).masked(masks).every(config.every)
        return replace(selected, trusted=config.trusted)
    except (ValueError, LogError) as error:
        raise ConfigError([str(error)]) from error


def read_frame(frame: Any, plant: PlantDescription, **keys: Any) -> Recording:
    """The plant's inputs and outputs in a pandas.DataFrame, by the rules of CSV files.

    Columns are named as a CSV file's (`h1_cm`, `h1 [cm]`), or as the plant's channels with their units in
    `frame.attrs["units"]`, as `Recording.to_pandas` gives it. Time is the index where that has a name, or a column.
    keys: what a run file says under `recordings:` beside the file, such as columns={"h1": {"column": "LT1", "unit":
    "mm"}}. Raises ConfigError naming row and column.
    """
    units = frame.attrs.get("units", {})

    def header(name: Any) -> Any:
        return f"{name} [{units[name]}]" if name in units else name

    timed = frame.index.name is not None
    named = frame.rename(columns=header)
    named = named.rename_axis(index=header(frame.index.name)) if timed else named
    with TemporaryDirectory() as folder:
        path = Path(folder) / "frame.csv"
        named.to_csv(path, index=timed)
        try:
            config = RecordingConfig.model_validate({"file": str(path), **keys})
            return replace(read_recording(config, plant), source="data frame", sha256="")
        except ValidationError as error:
            raise explain(error, "data frame") from None
        except ConfigError as error:
            raise ConfigError([problem.replace(str(path), "data frame") for problem in error.problems]) from None


def _read(
    config: RecordingConfig,
    path: Path,
    base: Path,
    plant: PlantDescription,
    inputs: Sequence[str],
    outputs: Sequence[str],
) -> Recording:
    """By the file's ending: an MCAP log (also one that was cut off while written), or else CSV."""
    mapping = channel_mapping(config, plant)
    if is_log(path):
        if config.also or config.tags or config.sheet or not config.header:
            raise ValueError(
                f"{config.file}: expected neither also, tags, sheet nor header beside an MCAP file; leave them"
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


def _levels(wanted: Any, plant: PlantDescription, config: RecordingConfig) -> dict[str, StartLevel]:
    tanks = [tank.name for tank in plant.tanks]
    if not isinstance(wanted, dict):
        return dict.fromkeys(tanks, wanted)
    for name in wanted:
        if name not in tanks:
            raise ConfigError([f"{config.file}: start_levels.{name}: {unknown('a tank', name, tanks)}"])
    return {tank: wanted.get(tank, "free") for tank in tanks}
