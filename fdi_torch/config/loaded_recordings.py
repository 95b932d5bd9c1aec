"""Reading the recordings that are meant, as the plant's inputs and outputs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
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
    configs: Sequence[RecordingConfig], plant: PlantDescription, base: Path | None = None
) -> list[LoadedRecording]:
    """Every recording, cut where an input is unknown."""
    return [part for config in configs for part in known_parts(read_recording(config, plant, base), config, plant)]


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


def read_recording(config: RecordingConfig, plant: PlantDescription, base: Path | None = None) -> Recording:
    """The plant's inputs and outputs: selected, masked and thinned, unknown inputs still in it (NaN)."""
    path = find_data(config.file, base or Path.cwd())
    channels, columns = plant.channels(), tuple(sensor.column for sensor in plant.sensors)
    try:
        recording = _read(config, path, base or Path.cwd(), plant, channels, columns)
        names = (*recording.input_names, *recording.output_names)
        expect_units(recording.source, names, (*recording.input_units, *recording.output_units), plant)
        start = -math.inf if config.start is None else in_seconds(config.start, recording, config)
        stop = math.inf if config.stop is None else in_seconds(config.stop, recording, config)
        masks = [(in_seconds(a, recording, config), in_seconds(b, recording, config)) for a, b in config.mask]
        return recording.window(start, stop).masked(masks).every(config.every)
    except (ValueError, LogError) as error:
        raise ConfigError([str(error)]) from error


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
        if config.also or config.tags:
            raise ValueError(f"{config.file}: expected neither also nor tags beside an MCAP file; leave them")
        return read_mcap(path, inputs, outputs, mapping, config.hold)
    files = [_source(config, path, mapping)]
    files += [_source(each, find_data(each.file, base), channel_mapping(each, plant)) for each in config.also]
    if not config.also and not config.tags:
        files = [FileSource(path, unrecorded_valves(path, plant) | mapping)]
    return read_csv_files(files, inputs, outputs, config.hold)


def _source(config: FileConfig, path: Path, mapping: Mapping[str, ChannelSource]) -> FileSource:
    if is_log(path):
        raise ValueError(f"{config.file}: expected a CSV file beside others, got an MCAP file")
    tags = config.tags
    return FileSource(path, mapping, None if tags is None else TagRows(tags.tag, tags.value, tags.quality))


def _levels(wanted: Any, plant: PlantDescription, config: RecordingConfig) -> dict[str, StartLevel]:
    tanks = [tank.name for tank in plant.tanks]
    if not isinstance(wanted, dict):
        return dict.fromkeys(tanks, wanted)
    for name in wanted:
        if name not in tanks:
            raise ConfigError([f"{config.file}: start_levels.{name}: {unknown('a tank', name, tanks)}"])
    return {tank: wanted.get(tank, "free") for tank in tanks}
