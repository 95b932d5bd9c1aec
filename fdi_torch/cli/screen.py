"""Output of a command: results on standard output, progress and errors on standard error.

Names, units and messages come from files that others wrote. All of them go through `_shown`: markup in them is not
interpreted, and terminal control characters are escaped.
"""

from __future__ import annotations

import io
import math
import os
import re
import sys
import textwrap
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import orjson
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Column, Table
from rich.text import Text

from fdi_torch.disk import named_errors
from fdi_torch.progress import Tell, silent
from fdi_torch.untrusted_input import printable, printable_json

if TYPE_CHECKING:
    from fdi_torch.tables import Table as Shown  # loads the library of units, for which quick commands do not wait

SECONDS_BETWEEN_LINES = 2.0
SECONDS_BETWEEN_EQUAL_LINES = 60.0  # a line that repeats the last one says only that the job still runs
ENDLESS = 1 << 16  # characters per line of a pipe or a file
_PARTS = re.compile(r"(?<=;) |(?<=,) (?=or )")


def log_words(log: Path) -> str:
    """Where the log is, and how it becomes a page."""
    return f"log: {log} (fdi report {log} makes the page)"


def _shown(text: str) -> Text:
    """The text without control characters; all text goes through here before it is printed."""
    return Text(printable(text))


class _Output(Console):
    """A standard stream. The work continues even if nobody reads on, so that the files it writes are complete."""

    def on_broken_pipe(self) -> None:
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), self.file.fileno())


class _Results(_Output):
    """Standard output."""

    def print(self, *what: Any, **how: Any) -> None:
        with named_errors("standard output"):
            super().print(*what, **how)


class Screen:
    """json: print results as JSON only. quiet: no progress. Progress is a bar on a terminal, otherwise plain lines."""

    def __init__(self, json: bool = False, quiet: bool = False) -> None:
        self.json = json
        self.quiet = quiet
        self._out = _Results(width=None if sys.stdout.isatty() else ENDLESS, highlight=False, soft_wrap=True)
        self._err = _Output(stderr=True, highlight=False, soft_wrap=True)

    def say(self, text: str = "", indent: int = 0) -> None:
        """Print a line of the result; not with JSON. indent: of the further lines into which a terminal folds it, if it
        has room for them: one for each statement and each of several alternatives.
        """
        if self.json:
            return
        folded = [text]
        if indent and self._out.is_terminal and self._out.width > 2 * indent:
            first, *others = _PARTS.split(text)
            parts = [first, *(" " * indent + part for part in others)]
            options: Any = {"subsequent_indent": " " * indent, "break_on_hyphens": False}
            folded = [line for part in parts for line in textwrap.wrap(part, self._out.width, **options)]
        for line in folded:
            self._out.print(_shown(line))

    def points(self, sentences: Iterable[str]) -> None:
        """Print each sentence as a point of a list; not with JSON."""
        for sentence in sentences:
            self.say(f"- {sentence}")

    def show(self, *tables: Shown) -> None:
        """Print tables between their titles and summaries; not with JSON, and none without a row.

        A column whose cells are all empty is left out. On a narrow terminal words are folded and numbers stay whole;
        elsewhere lines are not folded.
        """
        for shown in tables:
            if len(shown) and not self.json:
                self._show(shown)

    def _show(self, shown: Shown) -> None:
        rows, left = shown.cells(), shown.left
        if shown.title:
            self.say(shown.title)
        table = Table(box=None, pad_edge=False, header_style="bold")
        filled = [i for i in range(len(shown.header)) if any(row[i] for row in rows)]
        for i in filled:
            name, word = _shown(shown.header[i]), i < left
            table.add_column(name, justify="left" if word else "right", overflow="fold", no_wrap=not word)
        for row in rows:
            table.add_row(*(_shown(row[i]) for i in filled))
        self._out.print(table, soft_wrap=False)
        if shown.summary:
            self.say(shown.summary)

    def result(self, data: Any) -> None:
        """Print the result as JSON if requested; dataclasses are allowed, and non-finite numbers become null."""
        if self.json:
            options = orjson.OPT_INDENT_2 | orjson.OPT_SERIALIZE_DATACLASS | orjson.OPT_SERIALIZE_NUMPY
            try:
                text = orjson.dumps(data, option=options).decode()
            except orjson.JSONEncodeError as error:
                raise ValueError(
                    f"expected results that JSON can represent, got others: {error}; is a path not UTF-8?"
                ) from error
            self.line(text)

    def line(self, text: str) -> None:
        """Print a line of JSON immediately, for results that come one by one; only with JSON."""
        if self.json and not self._out.quiet:  # as long as someone reads standard output
            try:
                with named_errors("standard output"):
                    sys.stdout.write(printable_json(text) + "\n")
                    sys.stdout.flush()
            except BrokenPipeError:
                self._out.on_broken_pipe()

    @contextmanager
    def stream(self) -> Iterator[BinaryIO]:
        """Standard output for the bytes of a file; on a terminal, control characters are escaped."""
        with named_errors("standard output"):
            if not sys.stdout.isatty():
                yield sys.stdout.buffer
                sys.stdout.buffer.flush()
                return
            kept = io.BytesIO()
            yield kept
            sys.stdout.write(printable(kept.getvalue().decode("utf-8", "replace")))
            sys.stdout.flush()

    def note(self, text: str) -> None:
        """Print a line of progress."""
        if not self.quiet:
            self._err.print(_shown(text))

    def complain(self, text: str) -> None:
        """Print an error, also in quiet mode."""
        self._err.print(_shown(text))

    @contextmanager
    def progress(self, title: str) -> Iterator[Tell]:
        """A progress bar on a terminal; elsewhere a line at the start and then every few seconds."""
        if self.quiet:
            yield silent
        elif self._err.is_terminal:
            with self._bar() as bar:
                task = bar.add_task(printable(title), total=1.0, text="")
                yield lambda share, text: bar.update(
                    task, total=None if share is None else 1.0, completed=share, text=printable(text)
                )
        else:
            yield self._lines(title)

    def _bar(self) -> Progress:
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=20),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[text]}", markup=False, table_column=Column(ratio=1, no_wrap=True)),
        )
        return Progress(*columns, console=self._err, transient=True, expand=True)

    def _lines(self, title: str) -> Tell:
        self.note(f"{title} ...")
        last, shown = -math.inf, ""  # the first step of a job is shown at once

        def advance(share: float | None, text: str) -> None:
            nonlocal last, shown
            percent = "" if share is None else f" {share:4.0%}"
            line = f"{title}{percent} {text}".rstrip()
            wait = SECONDS_BETWEEN_LINES if line != shown else SECONDS_BETWEEN_EQUAL_LINES
            if share == 1.0 or time.monotonic() - last >= wait:
                last, shown = time.monotonic(), line
                self.note(line)

        return advance
