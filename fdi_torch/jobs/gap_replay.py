"""Repetition of a logged gap diagnosis from the log's recordings, plant and settings, for `fdi replay`."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from fdi_torch.config.logged_config import logged_plant
from fdi_torch.gap.diagnose import ProgressCallback, Settings
from fdi_torch.gap.structure_search import DEEPEST
from fdi_torch.jobs.gap import groups, run_gap
from fdi_torch.jobs.logged_recordings import logged_recording
from fdi_torch.logbook import LogError
from fdi_torch.logbook import Run as LoggedRun

LISTS, NUMBERS, YES_OR_NO = ("library", "leave_out"), ("step", "most"), {"true": True, "false": False}
SWITCHES = ("named_only", "trusted")
KEYS = (*LISTS, *NUMBERS, *SWITCHES)


def replay_gap(log: LoggedRun, path: Path, overrides: Iterable[str], tell: ProgressCallback, parent: str) -> None:
    """Repeat a diagnosis into the log `path`.

    overrides: changed settings, such as library=pump_lag,leak@T1, leave_out=pump_lag, step=0.5, named_only=true.
    """
    settings = settings_of(log, overrides)
    sources = [name for name in log.metadata.get("fdi_torch.data", {}) if name.endswith(".path")]
    diagnosed = int(log.metadata.get("fdi_torch.config", {}).get("recordings", 1))
    names = groups(max(len(sources) - diagnosed, 0), diagnosed)
    recordings = [logged_recording(log, group, k) for k, group in enumerate(names)]
    run_gap(path, logged_plant(log), recordings[:diagnosed], recordings[diagnosed:], settings, tell, parent)


def removed_options(log: LoggedRun) -> list[str]:
    """Notices about options of the logged diagnosis that no longer exist."""
    if log.metadata.get("fdi_torch.config", {}).get("settings.cross_validate") != "true":
        return []
    return [
        f"{log.path}: was made with --cross-validate, an option that no longer exists; the diagnosis is repeated "
        "without it and may give another explanation"
    ]


def settings_of(log: LoggedRun, overrides: Iterable[str] = ()) -> Settings:
    """The logged settings with overrides. Raises ValueError for an unknown key."""
    logged = log.metadata.get("fdi_torch.config", {})
    try:
        # Settings that older logs do not have.
        defaults = {"settings.most": str(DEEPEST), "settings.named_only": "false", "settings.trusted": "false"}
        values = {key: json.loads((defaults | logged)[f"settings.{key}"]) for key in KEYS}
    except (KeyError, ValueError) as error:
        raise LogError(f"{log.path}: expected the settings of a gap diagnosis, got none; run fdi gap again") from error
    for override in overrides:
        key, _, value = override.partition("=")
        if key not in KEYS:
            raise ValueError(f"--set {override}: expected one of {', '.join(KEYS)}, got {key}")
        values[key] = _parsed(key, value)
    library = tuple(values["library"]) if values["library"] else None
    return Settings(
        library, tuple(values["leave_out"]), values["step"], values["most"], values["named_only"], values["trusted"]
    )


def _parsed(key: str, value: str) -> Any:
    """The value of an override. Raises ValueError if its type is wrong."""
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
