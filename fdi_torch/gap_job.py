"""A gap diagnosis into a log: plant, recording, answer; all that a page, a viewer or a later reader needs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fdi_torch.config.plant_writer import dump_plant
from fdi_torch.log_paths import free_path
from fdi_torch.logbook import RunLog
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording


def log_gap(
    folder: Path,
    plant: PlantDescription,
    recording: Recording,
    answer: Mapping[str, Any],
    holdout: Recording | None = None,
    settings: Mapping[str, Any] | None = None,
) -> Path:
    """Writes gap.mcap, or the next free name, into the folder. answer: as JSON. Returns the log's path."""
    path = free_path(folder, "gap")
    sources = [{"path": r.source, "sha256": r.sha256} for r in (recording, holdout) if r is not None]
    config = {"settings": dict(settings or {})}
    with RunLog(path, "gap", config_text=dump_plant(plant), config=config, data=sources) as log:
        log.recording(
            recording.time,
            recording.inputs,
            recording.outputs,
            recording.input_names,
            recording.output_names,
            recording.input_units,
            recording.output_units,
            mask=recording.mask,
            hold=recording.hold,
        )
        for place in answer.get("where", ()):
            log.gap_where(place["location"], place["share"])
        log.gap_verdict(answer)
        log.result({"verdict": answer["verdict"], "closed": (answer.get("closure") or {}).get("closed")})
    return path
