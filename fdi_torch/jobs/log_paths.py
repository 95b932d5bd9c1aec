"""Path of the log that a job writes: a new one, or that of an unfinished run to resume."""

from __future__ import annotations

import os
import re
from itertools import chain, count
from pathlib import Path

import torch

from fdi_torch.estimate.evolution import Search
from fdi_torch.logbook import LogError, Message, being_written, last_state, read_run, set_aside, unfinished
from fdi_torch.logbook.reader import Run as Log

# Topics that a resumed run copies from the log of the killed run.
COPIED_TOPICS = (
    *("/plant/input", "/plant/output", "/plant/truth"),
    *("/estimator/de/generation", "/estimator/de/population"),
)

RESUMES = "the same command with --resume goes on from there"
STARTS_OVER = "the same command starts again from the beginning; it cannot be resumed"
ENDED = ("completed", "not_converged")
"""Statuses of a complete run; all others were interrupted or failed."""


def free_path(folder: Path, name: str, ending: str = "mcap") -> Path:
    """NAME.mcap in the folder, or NAME_2.mcap, NAME_3.mcap ... if it exists."""
    names = chain([name], (f"{name}_{k}" for k in count(2)))
    paths = (folder / f"{each}.{ending}" for each in names)
    return next(path for path in paths if not path.exists() and not partial_path(path).exists())


def partial_path(path: Path) -> Path:
    """Path of a log while its run lasts."""
    return path.with_name(path.name + ".partial")


def left_unfinished(folder: Path, name: str) -> Path | None:
    """The newest `.partial` log of that name, of any configuration, whose writer has ended; None if there is none."""
    pattern = re.compile(re.escape(name) + r"(_\d+)?\.mcap\.partial")
    files = [p for p in folder.glob("*.mcap.partial") if pattern.fullmatch(p.name) and p.stat().st_size]
    return max((p for p in files if not being_written(p)), key=lambda p: p.stat().st_mtime, default=None)


def find_unfinished(folder: Path, name: str, text: str) -> tuple[Path, Log | None] | None:
    """The newest unfinished log of that name, moved aside, and the path at which the resumed run writes its log.

    The log is None if the run was killed before it wrote its configuration. Returns None if there is no log of that
    name. Raises ValueError if all are finished, or if their configuration is not `text`.
    """
    pattern = re.compile(re.escape(name) + r"(_\d+)?\.mcap(\.partial)?")
    files = sorted((p for p in folder.glob("*.mcap*") if pattern.fullmatch(p.name)), reverse=True)
    # Of a log and its `.partial` file, which comes first, the log itself counts.
    paths = {p.with_suffix("") if p.suffix == ".partial" else p: p for p in files}
    if not paths:
        return None
    logs = {path: _read_log(path) for path in paths.values()}
    matching = {path: log for path, log in logs.items() if log is None or log.config_text == text}
    newest = max(matching or logs, key=lambda path: path.stat().st_mtime)
    if not matching:
        raise ValueError(f"{newest}: expected the log of this configuration, got another's; run without --resume")
    unfinished_paths = [path for path, log in matching.items() if not _has_ended(path, log)]
    if not unfinished_paths:
        raise ValueError(f"{newest}: expected a run that did not end, got a finished one; there is nothing to resume")
    chosen = max(unfinished_paths, key=lambda path: path.stat().st_mtime)
    path = chosen.with_suffix("") if chosen.suffix == ".partial" else chosen
    if chosen == path:
        os.replace(path, partial_path(path))
    if matching[chosen] is None:
        set_aside(path)
        return path, None
    return path, unfinished(path)


def log_to_write(folder: Path, name: str, text: str, resume: bool, begin: bool = False) -> tuple[Path, Log | None]:
    """Path of the log to write, and with `resume` the unfinished log of a run of the same configuration, if it began.

    begin: whether to start anew if there is no log of that name. Raises ValueError if there is none, or a finished one.
    """
    unfinished = find_unfinished(folder, name, text) if resume else None
    if resume and not begin and unfinished is None:
        raise ValueError(f"{folder}: expected an unfinished log {name}.mcap, got none; start without --resume")
    return unfinished or (free_path(folder, name), None)


def _has_ended(path: Path, log: Log | None) -> bool:
    status = {} if log is None or path.suffix == ".partial" else log.about("status")
    return status.get("status") in ENDED


def _read_log(path: Path) -> Log | None:
    """The log, or None if the run was killed before its configuration was on disk."""
    try:
        log = read_run(path, salvage=True)
    except LogError:
        if path.suffix == ".mcap":
            raise
        return None
    return log if log.config_text else None


def unfinished_search(log: Log | None, device: str) -> tuple[tuple[Message, ...], Search | None]:
    """Messages and search state of an unfinished run at its last complete generation."""
    state = None if log is None else last_state(log)
    if log is None or state is None:
        return (), None
    generation, arrays = state
    copied = (m for m in log.messages() if m.topic in COPIED_TOPICS and m.payload.get("generation", 0) <= generation)
    return tuple(copied), Search.from_dict({name: torch.tensor(each, device=device) for name, each in arrays.items()})
