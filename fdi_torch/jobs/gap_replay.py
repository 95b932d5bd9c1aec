"""A logged gap diagnosis done again from its own recordings, plant and settings; `fdi replay` calls it."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

from fdi_torch.config.logged import logged_plant
from fdi_torch.gap.diagnose import Settings, Tell
from fdi_torch.gap.which import DEEPEST
from fdi_torch.jobs.gap import groups, run_gap
from fdi_torch.jobs.logged_recordings import recording_in
from fdi_torch.logbook import LogError
from fdi_torch.logbook import Run as LoggedRun

KEYS = ("library", "leave_out", "step", "most")


def gap_again(log: LoggedRun, path: Path, overrides: Iterable[str], tell: Tell, parent: str) -> None:
    """Into the log `path`. overrides: library=pump_lag,leak@T1, leave_out=pump_lag, step=0.5."""
    settings = settings_of(log, overrides)
    sources = [name for name in log.metadata.get("fdi_torch.data", {}) if name.endswith(".path")]
    together = int(log.metadata.get("fdi_torch.config", {}).get("recordings", 1))
    names = groups(max(len(sources) - together, 0), together)
    every = [recording_in(log, group, k) for k, group in enumerate(names)]
    run_gap(path, logged_plant(log), every[:together], every[together:], settings, tell, parent)


def settings_of(log: LoggedRun, overrides: Iterable[str] = ()) -> Settings:
    """What the diagnosis was asked, with some of it changed. Raises ValueError for a key that there is not."""
    logged = log.metadata.get("fdi_torch.config", {})
    try:
        told = {key: json.loads(logged[f"settings.{key}"]) for key in KEYS if key != "most"}
        told["most"] = json.loads(logged.get("settings.most", str(DEEPEST)))
    except (KeyError, ValueError) as error:
        raise LogError(f"{log.path}: expected the settings of a gap diagnosis, got none; run fdi gap again") from error
    for override in overrides:
        key, _, value = override.partition("=")
        if key not in KEYS:
            raise ValueError(f"--set {override}: expected one of {', '.join(KEYS)}, got {key}")
        told[key] = json.loads(value) if key in ("step", "most") else [name for name in value.split(",") if name]
    library = tuple(told["library"]) if told["library"] else None
    named_only = bool(json.loads(logged.get("settings.named_only", "false")))
    return Settings(library, tuple(told["leave_out"]), told["step"], told["most"], named_only)
