"""The check of a recording that `fdi check` shows: each channel, and what a diagnosis would refuse or mask."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from fdi_torch.config.loaded_recordings import known_segments_of, read_recording
from fdi_torch.config.recording_config import RecordingConfig
from fdi_torch.gap.preprocess.acquisition import FEWEST, examined
from fdi_torch.gap.problem import MIN_READINGS
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording
from fdi_torch.recordings.check import RecordingCheck, check_recording
from fdi_torch.recordings.plant_limits import ChannelFinding


def checked(config: RecordingConfig, plant: PlantDescription, base: Path) -> tuple[Recording, RecordingCheck]:
    """A recording and its check: readings beyond the tanks, which make the rest meaningless, come first."""
    whole = read_recording(config, plant, base)
    check = check_recording(whole, plant)
    examinations = [examined(plant, part, thorough=True) for part in whole.known_segments()]
    problems = []
    for fault in (e.fault for e in examinations if e.fault):
        channels, pair = ", ".join(fault.channels), " and ".join(fault.channels)
        text = fault.text.removeprefix(f"{channels}: ").removeprefix(f"{pair} ")
        problems.append(ChannelFinding("slip", channels, text))
    problems += [
        ChannelFinding("stuck", s.sensor.column, s.text, {"start": s.start, "stop": s.stop})
        for e in examinations
        for s in e.stuck
    ]
    empty = [s for s in plant.sensors if _is_empty(whole, s.column, config)]
    for sensor in empty:
        text = f"no reading in {len(whole)} samples: wrong column, or leave sensor {sensor.name} out of the plant file"
        problems.insert(0, ChannelFinding("empty", sensor.column, text, {"samples": len(whole)}))
    silent = {sensor.column for sensor in empty}
    counts = zip(whole.output_names, whole.mask.sum(dim=0).tolist(), strict=True)
    few = {name: count for name, count in counts if count < MIN_READINGS and name not in silent}
    if few:
        text = (
            f"{min(few.values())} readings: fdi gap and fdi refit expect at least {MIN_READINGS}, "
            "of all recordings together"
        )
        if len(whole) < FEWEST:
            text += f"; units, swapped channels and clocks are examined from {FEWEST} samples on"
        problems.append(ChannelFinding("few", ", ".join(few), text, {"count": min(few.values())}))
    refused = {channel for e in examinations if e.fault for channel in e.fault.channels}
    doubts = [f for f in check.findings if not (f.kind in ("undersampled", "unit") and f.channel in refused)]
    doubts = [f for f in doubts if not (f.kind == "missing" and f.channel in silent)]
    beyond = [f for f in doubts if f.kind in ("range", "unit")]
    problems = [p for p in problems if not any(f.text in p.text for f in beyond)]
    return whole, replace(check, findings=(*beyond, *problems, *(f for f in doubts if f not in beyond)))


def _is_empty(whole: Recording, column: str, config: RecordingConfig) -> bool:
    """Whether an output has a column without a single reading, and is not said to be unrecorded."""
    if column not in whole.output_names or (column in config.columns and not config.columns[column].recorded):
        return False
    return not bool(torch.isfinite(whole.outputs[:, whole.output_names.index(column)]).any())


def usable_spans(recording: Recording, config: RecordingConfig, plant: PlantDescription) -> str:
    """The segments with all inputs known, as '0 to 40 s, 50 to 90 s'; empty if that is the whole recording."""
    segments = [part.recording for part in known_segments_of(recording, config, plant)]
    if len(segments) == 1 and len(segments[0]) == len(recording):
        return ""
    return ", ".join(f"{part.time[0]:g} to {part.time[-1]:g} s" for part in segments)
