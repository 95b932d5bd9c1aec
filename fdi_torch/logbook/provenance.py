"""Provenance of a run: versions, state of the code, hashes of the data."""

from __future__ import annotations

import platform
import subprocess
import sys
from collections.abc import Iterable
from functools import cache
from importlib import metadata
from pathlib import Path

PACKAGES = ("fdi_torch", "torch", "torchdiffeq", "numpy", "scipy", "mcap", "orjson", "zstandard", "pydantic")


def environment(packages: Iterable[str] = PACKAGES) -> dict[str, str]:
    """Versions of Python, the system and the packages that affect results; the number of threads."""
    versions = {"python": platform.python_version(), "system": platform.system(), "machine": platform.machine()}
    versions |= {package: version_of(package) for package in packages}
    torch = sys.modules.get("torch")
    if torch is not None:
        versions["threads"] = str(torch.get_num_threads())
    return versions


@cache
def version_of(package: str) -> str:
    """The version of a package: its `__version__` if imported, else from the installation."""
    try:
        imported = getattr(sys.modules.get(package), "__version__", None)
        return imported if isinstance(imported, str) else metadata.version(package)
    except metadata.PackageNotFoundError:
        return "absent"


def git_state(folder: Path | None = None) -> dict[str, str]:
    """The commit of the code and whether it was changed since; empty texts outside a repository."""
    # One process with the least work for git.
    options = ("--porcelain=v2", "--branch", "--untracked-files=no", "--no-ahead-behind", "--no-renames")
    command = ("git", "--no-optional-locks", "-C", str(folder or Path(__file__).parent), "status", *options)
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=5, check=True)
    except (OSError, subprocess.SubprocessError):
        return {"commit": "", "changed": ""}
    lines = done.stdout.splitlines()
    commit = next((line.split()[-1] for line in lines if line.startswith("# branch.oid ")), "")
    changed = any(not line.startswith("#") for line in lines)
    return {"commit": commit, "changed": "yes" if changed else "no"}
