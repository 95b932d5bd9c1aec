"""The kinds of YAML files, recognized by their keys, so that a file of the wrong kind is called what it is."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fdi_torch.config.problems import ConfigError

_OWN_KEYS = {
    "plant": ("tanks",),
    "study": ("study",),
    "monitor": ("fault_free", "recording", "source"),
    "rehearsal": ("reading_noise", "false_alarms", "faults_found", "naming"),
    "run": ("recordings", "simulate", "estimate"),
}
_READ_BY = {
    "study": "fdi study reads it; without its block study it is a run file",
    "monitor": "fdi monitor reads it",
    "rehearsal": "fdi rehearse reads it",
    "run": "fdi train and fdi simulate read it",
}


def expect_kind(data: Mapping[str, Any], kind: str, file: Path, expected: str = "") -> None:
    """Raises ConfigError if the keys of a file are those of another kind: plant, run, study, monitor or rehearsal.

    expected: what could be there, in words; by default a file of that kind. A run file may become a study by --set.
    """
    kinds = [each for each, keys in _OWN_KEYS.items() if any(key in data for key in keys)]
    base = "run" if kind == "study" else kind
    if not kinds or kinds[0] == kind or (base in kinds and (kind == "study" or "study" not in kinds)):
        return
    given = kinds[0]
    if given == "plant":
        advice = f"name it under the key plant of such a file: fdi new {kind} --plant {file.name} writes one"
    else:
        advice = _READ_BY[given]
    raise ConfigError([f"{file}: expected {expected or f'a {kind} file'}, got a {given} file; {advice}"])
