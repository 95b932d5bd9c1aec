"""The logs in a folder, each with its verdict, the size of its residuals and its state."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path

from fdi_torch.jobs.report import plant_of
from fdi_torch.logbook import being_written, read_run
from fdi_torch.quantities import quantity_text
from fdi_torch.report.material import gather
from fdi_torch.report.predictions import Progress, progress_of, residual_size
from fdi_torch.report.verdict import headline, kind_words

RUNNING, NO_END, UNREADABLE = "running", "did not end", "unreadable"
PARTIAL = ".partial"
COMMANDS = {"rehearsal": "rehearse"}
"""Command by the kind of log, where the names differ."""
UNSHOWN = (KeyError, IndexError, TypeError, ValueError, OverflowError, OSError)
"""Errors of a log that is damaged or was not written by this program."""


@dataclass(frozen=True)
class Entry:
    """One log. name: its path below the folder. verdict: its result in one sentence, or why it cannot be read.

    error: root mean square of the residuals in SI, NaN if unknown; error_text: in the plant's units. state: status of
    the run, or `RUNNING`, `NO_END` or `UNREADABLE`. started: UTC, as text. command: that wrote the log, such as train.
    """

    name: str
    path: Path
    kind: str
    verdict: str
    error: float
    error_text: str
    state: str
    started: str
    progress: Progress
    command: str = ""

    @property
    def cells(self) -> list[str]:
        """The entry below the headers of `SORTS`."""
        return [self.name, self.started, self.kind, self.state, self.error_text, self.verdict]

    @property
    def text(self) -> str:
        """All in which words are looked for, in lower case."""
        return f"{self.name} {self.kind} {self.command} {self.started} {self.verdict} {self.state}".casefold()


@dataclass
class LogList:
    """The logs below a folder. A log is read again only if it has changed."""

    folder: Path
    _read: dict[Path, tuple[tuple[int, int], Entry]] = field(default_factory=dict)

    def paths(self) -> dict[str, Path]:
        """Paths of all logs by name, complete and unfinished."""
        files = (p for ending in ("mcap", f"mcap{PARTIAL}") for p in self.folder.rglob(f"*.{ending}") if p.is_file())
        return {path.relative_to(self.folder).as_posix(): path for path in sorted(files)}

    def path(self, name: str) -> Path | None:
        """The log of that name; for an unfinished log that has ended meanwhile, the finished one. None if unknown."""
        paths = self.paths()
        return paths.get(name) or paths.get(name.removesuffix(PARTIAL))

    def entries(self) -> list[Entry]:
        """All logs. A log that disappears during reading is left out."""
        read = (self.entry(name, path) for name, path in self.paths().items())
        return [entry for entry in read if entry is not None]

    def entry(self, name: str, path: Path) -> Entry | None:
        """One log; None if it has disappeared."""
        try:
            about = path.stat()
            stamp = about.st_mtime_ns, about.st_size
            running = path.suffix == PARTIAL and (not about.st_size or being_written(path))
        except FileNotFoundError:
            return None
        except OSError as error:
            return _unreadable(name, path, str(error), False)
        known = self._read.get(path)
        if known is None or known[0] != stamp or (known[1].state == RUNNING) != running:
            known = self._read[path] = stamp, _read(name, path, running)
        return known[1]


def _read(name: str, path: Path, running: bool) -> Entry:
    try:
        log = read_run(path, salvage=True)
        material = gather(log, plant_of(log, []))
        error, unit, sensor = residual_size(material)
        with material.in_its_units():
            error_text = quantity_text(error, unit, 3, sensor) if error == error else ""
        kind, progress = kind_words(material), progress_of(material)
        state, verdict = (RUNNING, progress.text) if running else (material.status or NO_END, headline(material))
        command = COMMANDS.get(material.kind, material.kind)
        return Entry(name, path, kind, verdict, error, error_text, state, material.started, progress, command)
    except UNSHOWN as problem:
        return _unreadable(name, path, str(problem), running)


def _unreadable(name: str, path: Path, problem: str, running: bool) -> Entry:
    """An entry for a log that cannot be read; that of a job which has just begun may still be empty."""
    state, verdict = (RUNNING, "started") if running else (UNREADABLE, problem)
    return Entry(name, path, "", verdict, math.nan, "", state, "", Progress(verdict))


_PLAIN = {name: name for name in ("log", "started", "kind", "state", "error", "verdict")}
SORTS = _PLAIN | {"started": "started, UTC"}
"""Headers of the columns of the list, by which it can be sorted."""


def selected(
    entries: Iterable[Entry], text: str = "", kind: str = "", sort: str = "started", down: bool = True
) -> list[Entry]:
    """The entries of that kind which contain every word of `text`, sorted; unknown errors come last."""
    words = text.casefold().split()
    kept = [entry for entry in entries if kind in ("", entry.kind) and all(word in entry.text for word in words)]
    key = attrgetter("name" if sort == "log" else sort)
    if sort != "error":
        return sorted(kept, key=key, reverse=down)
    known = sorted((entry for entry in kept if not math.isnan(entry.error)), key=key, reverse=down)
    return known + [entry for entry in kept if math.isnan(entry.error)]
