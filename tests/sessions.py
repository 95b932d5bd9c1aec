"""Run the console sessions of a Markdown page, and compare what they print with what the page shows.

A fenced block with a title (```yaml title="rig.yaml") is a file of the session. A block ```console holds commands
after `$ ` and the lines that they print; a line `...` stands for any lines. Words must be equal, and numbers to 0.1 %
or to one unit of the last digit shown. `python -m tests.sessions PAGE ...` runs pages and
rewrites the shown lines in place.
"""

from __future__ import annotations

import contextlib
import difflib
import io
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from fdi_torch.cli import DONE, NOT_EXPLAINED, main

BLOCK = re.compile(r"^```(\w+)(?: title=\"([^\"]+)\")?[^\n]*\n(.*?)^```$", re.S | re.M)
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
ELLIPSIS = "..."
FINE = (DONE, NOT_EXPLAINED)  # pages also show what a model that does not fit looks like


def run_page(text: str, handle: Callable[[str, list[str], list[str]], None]) -> None:
    """Run the page's session in the current directory. handle(command, expected, printed) is called per command."""
    for language, title, body in BLOCK.findall(text):
        if title:
            Path(title).write_text(body, encoding="utf-8")
        elif language == "console":
            for command, expected in commands(body):
                handle(command, expected, run_command(command))


def commands(body: str) -> Iterator[tuple[str, list[str]]]:
    """Commands of a console block with the lines shown below them; a trailing backslash continues a command."""
    for part in re.split(r"^\$ ", body, flags=re.M)[1:]:
        command, *shown = re.sub(r"\\\n\s*", "", part).splitlines()
        yield command, shown


def run_command(command: str) -> list[str]:
    """The lines that a command prints on standard output. Raises AssertionError if it fails."""
    words = shlex.split(command, comments=True)
    if words[0] != "fdi":
        done = subprocess.run(command, shell=True, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{command}: {done.stderr}"
        return done.stdout.splitlines()
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(words[1:])
    assert code in FINE, f"{command}: exit code {code}: {err.getvalue()}"
    return out.getvalue().splitlines()


def same(expected: str, printed: str) -> bool:
    """Whether two lines have equal words, and numbers equal to 0.3 % or to one unit of the last digit shown."""
    if [*NUMBER.sub("#", expected).split()] != [*NUMBER.sub("#", printed).split()]:
        return False
    pairs = zip(NUMBER.findall(expected), NUMBER.findall(printed), strict=True)
    return all(abs(float(a) - float(b)) <= max(0.003 * abs(float(a)), last_digit(a)) for a, b in pairs)


def last_digit(number: str) -> float:
    mantissa, _, exponent = number.partition("e")
    return 1.001 * 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))


def check(command: str, expected: list[str], printed: list[str]) -> None:
    """Raises AssertionError at the first shown line that the command did not print, in order."""
    if not expected:
        return
    at, free = 0, False
    for line in expected:
        if line == ELLIPSIS:
            free = True
            continue
        found = next((k for k in range(at, len(printed)) if same(line, printed[k])), None)
        assert found is not None and (free or found == at), f"$ {command}\nshown, not printed: {line}\n" + "\n".join(
            printed
        )
        at, free = found + 1, False
    assert free or at == len(printed), f"$ {command}\nprinted, not shown: " + "\n".join(printed[at:])


def renewed(expected: list[str], printed: list[str]) -> list[str]:
    """The shown lines with each replaced by the most similar printed line after the one before it."""
    at, lines = 0, []
    for line in expected:
        best = max(range(at, len(printed)), key=lambda k: _likeness(line, printed[k]), default=None)
        if line == ELLIPSIS:
            lines.append(line)
        elif best is None or _likeness(line, printed[best]) < 0.5:
            print(f"no line like: {line}", file=sys.stderr)
            lines.append(line)
        else:
            lines.append(printed[best].rstrip())
            at = best + 1
    return lines


def _likeness(a: str, b: str) -> float:
    return difflib.SequenceMatcher(None, a, b, autojunk=False).ratio()


def rewrite(page: Path) -> None:
    """Run the page's session in a temporary folder and put what it prints in place of what the page shows."""
    text = page.read_text(encoding="utf-8")
    replaced: list[tuple[str, str]] = []

    def handle(command: str, expected: list[str], printed: list[str]) -> None:
        new = printed if expected == ["?"] else renewed(expected, printed)
        if new != expected:
            replaced.append(("\n".join(expected), "\n".join(new)))

    here = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            run_page(text, handle)
        finally:
            os.chdir(here)
    for old, new in replaced:
        text = text.replace(f"{old}\n", f"{new}\n", 1)
    page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    for name in sys.argv[1:]:
        rewrite(Path(name).resolve())
