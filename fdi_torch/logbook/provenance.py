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
    folder = folder or Path(__file__).parent
    # One process with the least work for git.
    options = ("--porcelain=v2", "--branch", "--untracked-files=no", "--no-ahead-behind", "--no-renames")
    lines = _git(folder, "status", *options).splitlines()
    commit = next((line.split()[-1] for line in lines if line.startswith("# branch.oid ")), "")
    changed = any(not line.startswith("#") for line in lines)
    return {"commit": commit, "changed": "yes" if changed else "no" if commit else ""}


def _git(folder: Path, *arguments: str) -> str:
    try:
        command = ["git", "--no-optional-locks", "-C", str(folder), *arguments]
        done = subprocess.run(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, timeout=5, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""
