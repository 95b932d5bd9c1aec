"""How long a user waits before anything happens: CPU seconds of whole processes, beside one that imports NumPy."""

from __future__ import annotations

import os
import subprocess
import sys
from functools import partial
from statistics import median

ROUNDS = 7
COMMANDS = {
    "python -c 'import numpy'": ["-c", "import numpy"],
    "python -c 'import fdi_torch'": ["-c", "import fdi_torch"],
    "fdi --help": ["-m", "fdi_torch", "--help"],
    "fdi train --help": ["-m", "fdi_torch", "train", "--help"],
    "fdi gap --help": ["-m", "fdi_torch", "gap", "--help"],
    "python -c 'import torch'": ["-c", "import torch"],
}
Row = tuple[str, float, float]


def measure(budget: float) -> list[Row]:
    """Command, CPU seconds (median of rounds in which all take turns), and that over NumPy's. budget is unused."""
    runs = [partial(_seconds, words) for words in COMMANDS.values()]
    for run in runs:
        run()  # so that all files are in the machine's memory
    spent = [median(column) for column in zip(*([run() for run in runs] for _ in range(ROUNDS)), strict=True)]
    return [(name, own, own / spent[0]) for name, own in zip(COMMANDS, spent, strict=True)]


def _seconds(words: list[str]) -> float:
    """CPU seconds of a process and of its children."""
    before = os.times()
    subprocess.run([sys.executable, *words], check=True, stdout=subprocess.DEVNULL)
    after = os.times()
    return after.children_user + after.children_system - before.children_user - before.children_system


def table(rows: list[Row]) -> str:
    lines = ["| process | CPU seconds | times import numpy |", "|---|---|---|"]
    return "\n".join(lines + [f"| `{name}` | {own:.2f} | {ratio:.1f} |" for name, own, ratio in rows])
