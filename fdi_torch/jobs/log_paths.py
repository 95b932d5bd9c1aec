"""Which log a job writes: one under a free name, or that of a run that did not end, from which it goes on."""

from __future__ import annotations

import os
import re
from itertools import count
from pathlib import Path

import torch

from fdi_torch.config.run_file import Run
from fdi_torch.estimate.evolution import Search
from fdi_torch.logbook import LogError, Message, last_state, read_run, set_aside, unfinished
from fdi_torch.logbook.reader import Run as Log

# What a resumed run takes over from the log of the killed one.
KEPT = ("/plant/input", "/plant/output", "/plant/truth", "/estimator/de/generation", "/estimator/de/population")

RESUMES = "the same command with --resume goes on from there"
STARTS_ANEW = "the same command starts anew: it cannot go on from a log"
ENDED = ("completed", "not_converged")
"""Statuses of a run that came to its end; the others were interrupted or failed."""


def free_path(folder: Path, name: str, ending: str = "mcap") -> Path:
    """NAME.mcap in the folder, or NAME_2.mcap, NAME_3.mcap ... where that is taken."""
    for k in count(1):
        path = folder / (f"{name}.{ending}" if k == 1 else f"{name}_{k}.{ending}")
        if not path.exists() and not partial_of(path).exists():
            return path
    raise AssertionError("unreachable")


def partial_of(path: Path) -> Path:
    """Where a log stands until its run ends."""
    return path.with_name(path.name + ".partial")


def go_on_from(folder: Path, name: str, text: str) -> tuple[Path, Log | None] | None:
    """The newest log of that name that its run did not bring to an end, set aside, and the path to write it anew at.

    The log is None where the run was killed before it wrote its configuration. None: there is no log of that name.
    Raises ValueError where there are only finished ones, or the run had another configuration than `text`.
    """
    paths = {p.with_suffix("") if p.suffix == ".partial" else p: p for p in _logs_of(folder, name)}
    if not paths:
        return None
    logs = {path: _opened(path) for path in paths.values()}
    own = {path: log for path, log in logs.items() if log is None or log.config_text == text}
    newest = max(own or logs, key=lambda path: path.stat().st_mtime)
    if not own:
        raise ValueError(f"{newest}: expected the log of this configuration, got another's; run without --resume")
    started = [path for path, log in own.items() if not _has_ended(path, log)]
    if not started:
        raise ValueError(f"{newest}: expected a run that did not end, got a finished one; there is nothing to resume")
    found = max(started, key=lambda path: path.stat().st_mtime)
    path = found.with_suffix("") if found.suffix == ".partial" else found
    if found == path:
        os.replace(path, partial_of(path))
    if own[found] is None:
        set_aside(path)
        return path, None
    return path, unfinished(path)


def _logs_of(folder: Path, name: str) -> list[Path]:
    """NAME.mcap, NAME_2.mcap ..., and those with `.partial` behind; an ended log comes behind its own `.partial`."""
    own = re.compile(re.escape(name) + r"(_\d+)?\.mcap(\.partial)?")
    return sorted((p for p in folder.glob("*.mcap*") if own.fullmatch(p.name)), reverse=True)


def _has_ended(path: Path, log: Log | None) -> bool:
    told = {} if log is None or path.suffix == ".partial" else log.metadata.get("fdi_torch.status", {})
    return told.get("status") in ENDED


def _opened(path: Path) -> Log | None:
    """None where the run was killed before its configuration was on disk."""
    try:
        log = read_run(path, salvage=True)
    except LogError:
        if path.suffix == ".mcap":
            raise
        return None
    return log if log.config_text else None


def left_behind(folder: Path, run: Run) -> tuple[Path, tuple[Message, ...], Search | None]:
    """The path of the log to go on with, and what an unfinished run logged until its last whole generation: its
    messages and the state of its search there.
    """
    found = go_on_from(folder, run.name, run.text)
    if found is None:
        raise ValueError(f"{folder}: expected an unfinished log {run.name}.mcap, got none; start without --resume")
    path, before = found
    state = None if before is None else last_state(before)
    if before is None or state is None:
        return path, (), None
    generation, arrays = state
    kept = (m for m in before.messages() if m.topic in KEPT and m.payload.get("generation", 0) <= generation)
    return path, tuple(kept), Search.from_dict({name: torch.tensor(array) for name, array in arrays.items()})
