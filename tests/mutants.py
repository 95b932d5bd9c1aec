"""Mutation test: deliberate faults in the core, each of which the tests of its room must notice.

`mutants.yaml` lists them: a text of the source, the text with the fault, and the tests to run. They are chosen by hand,
because the operators of mutation tools (mutmut, Cosmic Ray) make thousands of mutants, few of which are mistakes that a
person makes: a missing term, a wrong bound, a factor, an ignored argument.

    python -m tests.mutants [WORD ...]        all, or those with one of the words in their file or description
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import os
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import yaml

ROOT = Path(__file__).resolve().parents[1]
LEFT_OUT = (".*", "__pycache__", "logs", "node_modules", "site")
LEAST_KILLED = 0.85
PASSED, FAILED = 0, 1  # exit codes of pytest; any other means that the tests did not run


class Mutant(NamedTuple):
    """breaks: what the fault breaks. before, after: a text that occurs once in `file`, and the text with the fault."""

    breaks: str
    file: str
    before: str
    after: str
    tests: list[str]

    def applied_to(self, text: str) -> str:
        """The source with the fault. Raises ValueError if `before` does not occur once."""
        if text.count(self.before) != 1:
            raise ValueError(f"{self.file}: expected one line `{self.before}`, got {text.count(self.before)}")
        return text.replace(self.before, self.after)


def mutants() -> list[Mutant]:
    """All deliberate faults."""
    return [Mutant(**each) for each in yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8"))]


def exit_code(root: Path, tests: Sequence[str]) -> int:
    """That of pytest in a fork of this process: libraries are imported once, the tree `root` in each fork."""
    process = multiprocessing.get_context("fork").Process(target=_run, args=(root, tests))
    process.start()
    process.join()
    return process.exitcode if process.exitcode is not None else FAILED


def _run(root: Path, tests: Sequence[str]) -> None:
    import pytest

    os.chdir(root)
    sys.path = [str(root), *(folder for folder in sys.path if Path(folder).resolve() != ROOT)]
    sys.modules.pop("tests", None)
    sys.dont_write_bytecode = False  # in the copy, where it halves the time of an import
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        sys.exit(int(pytest.main(["-x", "-p", "no:cacheprovider", *tests])))


def main(arguments: Sequence[str]) -> int:
    """Print what became of each fault; 1 if more than 15 % survived."""
    parser = argparse.ArgumentParser("python -m tests.mutants", description="Run tests on deliberate faults.")
    parser.add_argument("words", nargs="*", metavar="WORD", help="only faults with one in their file or description")
    words = parser.parse_args(arguments).words
    chosen = [m for m in mutants() if not words or any(word in f"{m.file} {m.breaks}" for word in words)]
    if not chosen:
        parser.error(f"expected a word of a fault's file or description, got {' '.join(words)}")
    for library in ("torch", "scipy.optimize", "scipy.stats", "pydantic", "matplotlib.pyplot", "pytest"):
        __import__(library)
    survivors = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / ROOT.name
        shutil.copytree(ROOT, copy, symlinks=True, ignore=shutil.ignore_patterns(*LEFT_OUT))
        if exit_code(copy, sorted({test for m in chosen for test in m.tests})) != PASSED:
            raise SystemExit("expected tests that pass without a fault, got one that fails; run `make test`")
        for second, mutant in enumerate(chosen):
            file = copy / mutant.file
            file.write_text(mutant.applied_to(file.read_text(encoding="utf-8")), encoding="utf-8")
            os.utime(file, (second, second))  # its own time, so that no bytecode of another source counts as its own
            code = exit_code(copy, mutant.tests)
            shutil.copy2(ROOT / mutant.file, file)
            if code not in (PASSED, FAILED):
                raise SystemExit(f"{mutant.file}: expected a fault that lets tests run, got exit code {code} of pytest")
            survivors += code == PASSED
            print("SURVIVED" if code == PASSED else "killed  ", f"{mutant.file}: {mutant.breaks}", flush=True)
    print(f"{len(chosen) - survivors} of {len(chosen)} deliberate faults were noticed by the tests of their room")
    return int(survivors > (1.0 - LEAST_KILLED) * len(chosen))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
