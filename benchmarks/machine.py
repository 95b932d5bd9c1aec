"""Where and with what a table was measured."""

from __future__ import annotations

import os
import platform
import subprocess
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGES = ("torch", "torchdiffeq", "numpy", "scipy", "numba", "jax", "diffrax", "evosax", "evox")


def describe(arguments: list[str]) -> str:
    """Machine, load, versions, command and date, as a paragraph of Markdown."""
    cpu = next(
        (x.split(":")[1].strip() for x in _lines("/proc/cpuinfo") if x.startswith("model name")), platform.machine()
    )
    compiler = subprocess.run(["g++", "--version"], capture_output=True, text=True, check=False).stdout.split("\n")[0]
    command = "python -m benchmarks " + " ".join(arguments[1:])
    versions = ", ".join(f"{name} {v}" for name in PACKAGES if (v := _version(name)))
    load = ", ".join(f"{x:.1f}" for x in os.getloadavg())
    return (
        f"`{command.strip()}` on {datetime.now(UTC):%Y-%m-%d %H:%M} UTC: {cpu}, {os.cpu_count()} cores, "
        f"load {load}; Python {platform.python_version()}, {compiler}, {versions}. One thread each; CPU time, best of "
        "several runs, compilation left out.\n"
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
