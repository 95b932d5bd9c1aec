"""Where and with what a table was measured."""

from __future__ import annotations

import os
import platform
import subprocess
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGES = ("torch", "torchdiffeq", "numpy", "scipy", "numba", "jax", "diffrax", "evosax", "evox")


def occasion(arguments: list[str]) -> str:
    """Command, date and load, as a paragraph of Markdown."""
    load = ", ".join(f"{x:.1f}" for x in os.getloadavg())
    command = "python -m benchmarks " + " ".join(arguments[1:])
    return f"`{command.strip()}` on {datetime.now(UTC):%Y-%m-%d %H:%M} UTC, load {load}.\n"


def describe() -> str:
    """Machine and versions, as a paragraph of Markdown."""
    cpu = next(
        (x.split(":")[1].strip() for x in _lines("/proc/cpuinfo") if x.startswith("model name")), platform.machine()
    )
    compiler = subprocess.run(["g++", "--version"], capture_output=True, text=True, check=False).stdout.split("\n")[0]
    versions = ", ".join(f"{name} {v}" for name in PACKAGES if (v := _version(name)))
    return (
        f"{cpu}, {os.cpu_count()} cores; Python {platform.python_version()}, {compiler}, {versions}. One thread each, "
        "CPU time, compilation left out: the median of rounds in which all take turns.\n"
    )


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _lines(path: str) -> list[str]:
    try:
        return Path(path).read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
