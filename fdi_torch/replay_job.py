"""A logged run done again from its own recordings, configuration and seeds; `fdi replay` calls it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch

from fdi_torch.config.files import with_overrides
from fdi_torch.config.logged import logged_mapping
from fdi_torch.config.recordings import LoadedRecording
from fdi_torch.config.run import Run, build_run
from fdi_torch.logbook import LogError, RunLog, own_signals, series
from fdi_torch.logbook import Run as LoggedRun
from fdi_torch.main_job import Tell, estimate_logged, log_recordings, origin_of
from fdi_torch.recording import Recording
from fdi_torch.run_setup import fitting_of, wanted_space

# The data are the log's own: what would make others cannot be changed.
_DATA_KEYS = ("simulate", "recordings")


def run_again(log: LoggedRun, path: Path, overrides: Iterable[str] = (), tell: Tell | None = None) -> Path:
    """Estimates again what a log of `fdi train` says, into a new log whose parent it is. Returns the new log's path.

    Raises LogError for other logs, ConfigError for a configuration that cannot be used, ValueError for overrides of
    the data.
    """
    kind = log.metadata.get("fdi_torch.run", {}).get("kind", "")
    if kind != "train":
        raise LogError(f"{log.path}: expected a log of fdi train, got one of {kind or 'another program'}")
    run = asked_again(log, overrides)
    space, loaded = wanted_space(run), recorded(log, run)
    fitting = fitting_of(run, space, loaded)
    parent = log.metadata["fdi_torch.run"].get("run_id", "")
    with RunLog(path, "train", **origin_of(run, loaded), parent_run_id=parent) as again:
        log_recordings(again, loaded, logged_truth(log))
        estimate_logged(run, fitting, again, tell or (lambda share, text: None))
    return path


def asked_again(log: LoggedRun, overrides: Iterable[str] = ()) -> Run:
    """The run as its log describes it, with some values changed."""
    overrides = list(overrides)
    for override in overrides:
        if override.split("=")[0].split(".")[0] in _DATA_KEYS:
            raise ValueError(f"--set {override}: expected a key other than the data's, got one; use fdi train")
    return build_run(with_overrides(logged_mapping(log), overrides), log.path.parent, str(log.path))


def recorded(log: LoggedRun, run: Run) -> list[LoadedRecording]:
    """The recordings in a log, with what its configuration says of their start levels."""
    topics = dict.fromkeys(m.topic for m in log.messages() if m.topic.startswith("/plant/"))
    groups = [
        topic.removeprefix("/plant").strip("/").removesuffix("output").strip("/")
        for topic in topics
        if topic.endswith("/output")
    ]
    levels = start_levels(run, len(groups), log.path)
    return [
        LoadedRecording(recording_in(log, group, k), level)
        for k, (group, level) in enumerate(zip(groups, levels, strict=True))
    ]


def start_levels(run: Run, count: int, path: Path) -> list[Any]:
    """What is known of the levels at the start of each recording."""
    if run.config.simulate is not None:
        return [run.config.simulate.start_levels] * count
    if count != len(run.config.recordings):
        raise LogError(f"{path}: expected {len(run.config.recordings)} recordings, got {count}; it cannot be run again")
    tanks = [tank.name for tank in run.plant.tanks]
    wanted = [recording.start_levels for recording in run.config.recordings]
    return [{t: w.get(t, "free") if isinstance(w, dict) else w for t in tanks} for w in wanted]


def recording_in(log: LoggedRun, group: str, number: int) -> Recording:
    """A logged recording, with the name and the fingerprint of the file that it was read from."""
    signals, about = own_signals(log, group), log.metadata.get("fdi_torch.data", {})
    time, inputs, outputs = (torch.as_tensor(a) for a in (signals.time, signals.inputs, signals.outputs))
    return Recording(
        time=time,
        inputs=inputs,
        outputs=outputs,
        input_names=signals.input_names,
        output_names=signals.output_names,
        input_units=signals.input_units,
        output_units=signals.output_units,
        mask=torch.as_tensor(signals.mask),
        hold=signals.hold,  # type: ignore[arg-type]
        source=about.get(f"{number}.path", str(log.path)),
        sha256=about.get(f"{number}.sha256", ""),
    )


def logged_truth(log: LoggedRun) -> dict[str, float]:
    """What was simulated, SI by full name; empty for real data."""
    truth = series(log, "/plant/truth")
    return {name: float(values[0]) for name, values in truth.items() if name != "t" and len(values)}
