"""A logged gap diagnosis done again from its own recordings, plant and settings; `fdi replay` calls it."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from fdi_torch.config.logged_config import logged_plant
from fdi_torch.gap.diagnose import Settings, Tell
from fdi_torch.gap.search import DEEPEST
from fdi_torch.jobs.gap import groups, run_gap
from fdi_torch.jobs.logged_recordings import recording_in
from fdi_torch.logbook import LogError
from fdi_torch.logbook import Run as LoggedRun

LISTS, NUMBERS, YES_OR_NO = ("library", "leave_out"), ("step", "most"), {"true": True, "false": False}
SWITCHES = ("named_only", "trusted")
KEYS = (*LISTS, *NUMBERS, *SWITCHES)


def gap_again(log: LoggedRun, path: Path, overrides: Iterable[str], tell: Tell, parent: str) -> None:
    """Into the log `path`. overrides: library=pump_lag,leak@T1, leave_out=pump_lag, step=0.5, named_only=true."""
    settings = settings_of(log, overrides)
    sources = [name for name in log.metadata.get("fdi_torch.data", {}) if name.endswith(".path")]
    together = int(log.metadata.get("fdi_torch.config", {}).get("recordings", 1))
    names = groups(max(len(sources) - together, 0), together)
    every = [recording_in(log, group, k) for k, group in enumerate(names)]
    run_gap(path, logged_plant(log), every[:together], every[together:], settings, tell, parent)


def no_longer_done(log: LoggedRun) -> list[str]:
    """What the logged diagnosis was asked to do that no diagnosis does any more, a sentence each."""
    if log.metadata.get("fdi_torch.config", {}).get("settings.cross_validate") != "true":
        return []
    return [
        f"{log.path}: was made with --cross-validate, an option that no longer exists; the diagnosis is done again "
        "without it, so that another explanation may come out"
    ]


def settings_of(log: LoggedRun, overrides: Iterable[str] = ()) -> Settings:
    """What the diagnosis was asked, with some of it changed. Raises ValueError for a key that there is not."""
    logged = log.metadata.get("fdi_torch.config", {})
    try:
        since_later = {"settings.most": str(DEEPEST), "settings.named_only": "false", "settings.trusted": "false"}
        told = {key: json.loads((since_later | logged)[f"settings.{key}"]) for key in KEYS}
    except (KeyError, ValueError) as error:
        raise LogError(f"{log.path}: expected the settings of a gap diagnosis, got none; run fdi gap again") from error
    for override in overrides:
        key, _, value = override.partition("=")
        if key not in KEYS:
            raise ValueError(f"--set {override}: expected one of {', '.join(KEYS)}, got {key}")
        told[key] = _given(key, value)
    library = tuple(told["library"]) if told["library"] else None
    return Settings(library, tuple(told["leave_out"]), told["step"], told["most"], told["named_only"], told["trusted"])


def _given(key: str, value: str) -> Any:
    """The value of an override. Raises ValueError where it is of another kind."""
    if key in LISTS:
        return [name for name in value.split(",") if name]
    if key in SWITCHES:
        if value not in YES_OR_NO:
            raise ValueError(f"--set {key}={value}: expected true or false, got {value or 'nothing'}")
        return YES_OR_NO[value]
    try:
        number = json.loads(value)
    except ValueError:
        number = None
    if key == "step" and value == "null":
        return None
    if isinstance(number, bool) or not isinstance(number, int if key == "most" else (int, float)) or number <= 0:
        raise ValueError(f"--set {key}={value}: expected a positive number, got {value or 'nothing'}")
    return number
