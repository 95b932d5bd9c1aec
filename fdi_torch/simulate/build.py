"""Compiles a source into a library once and keeps it in a cache that all processes of this machine share."""

from __future__ import annotations

import ctypes
import hashlib
import importlib.util
import os
import platform
import shutil
import subprocess
import tempfile
from functools import lru_cache
from pathlib import Path

_FLAGS = (
    "-std=c++17", "-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast",
    "-fno-strict-aliasing", "-fPIC", "-shared", "-pthread",
)  # fmt: skip


class BuildError(RuntimeError):
    """The machine has no C++ compiler, or it did not take the source."""


Command = tuple[str, ...]


def find_compiler() -> Command | None:
    """$CXX, or else the first of g++, c++ and clang++ on the PATH, or else the one in the package ziglang."""
    names = [os.environ["CXX"]] if os.environ.get("CXX") else ["g++", "c++", "clang++"]
    found = next((path for path in map(shutil.which, names) if path), None)
    return (found,) if found else _packaged_compiler()


def _packaged_compiler() -> Command | None:
    package = importlib.util.find_spec("ziglang")
    for folder in (package.submodule_search_locations or []) if package else []:
        if (Path(folder) / "zig").is_file():
            return str(Path(folder) / "zig"), "c++"
    return None


def warm_up() -> None:
    """Lets a packaged compiler build its own library once, which takes it a minute. Raises BuildError."""
    load_library("#include <thread>\n#include <vector>\nstd::vector<std::thread> threads;\n")


def cache_folder() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "fdi_torch"


def is_cached(source: str) -> bool:
    """Whether the source has been compiled on this machine before."""
    compiler = find_compiler()
    return compiler is not None and _library(compiler, source).exists()


def load_library(source: str) -> ctypes.CDLL:
    """The compiled source, from the cache if it is there. Raises BuildError."""
    compiler = find_compiler()
    if compiler is None:
        raise BuildError(
            "expected a C++ compiler, got none on the PATH; install g++, or fdi_torch[compiler], or set CXX"
        )
    library = _library(compiler, source)
    if not library.exists():
        _compile(compiler, source, library)
    return ctypes.CDLL(str(library))


def _library(compiler: Command, source: str) -> Path:
    key = "\0".join([source, *_FLAGS, _identity(compiler), _processor()])
    return cache_folder() / f"{hashlib.sha256(key.encode()).hexdigest()[:24]}.so"


def _compile(compiler: Command, source: str, library: Path) -> None:
    try:
        library.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=library.parent) as folder:
            code, built = Path(folder) / "kernel.cpp", Path(folder) / "kernel.so"
            code.write_text(source, encoding="utf-8")
            done = subprocess.run(
                [*compiler, *_FLAGS, str(code), "-o", str(built)], capture_output=True, text=True, check=False
            )
            if done.returncode:
                raise BuildError(
                    f"expected {' '.join(compiler)} to compile the plant, got: {done.stderr.strip()[:2000]}"
                )
            built.replace(library)  # atomic: other processes see all of it or nothing
    except OSError as error:
        raise BuildError(f"expected to write to {library.parent}, got {error}; set XDG_CACHE_HOME") from error


@lru_cache(maxsize=8)
def _identity(compiler: Command) -> str:
    stat = os.stat(compiler[0])
    return f"{os.path.realpath(compiler[0])} {stat.st_size} {stat.st_mtime_ns}"


@lru_cache(maxsize=1)
def _processor() -> str:
    """What `-march=native` depends on."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return f"{platform.machine()} {platform.processor()} {platform.node()}"
    wanted = ("model name", "flags", "Features", "CPU implementer", "CPU part")
    return "\n".join(dict.fromkeys(line for line in lines if line.startswith(wanted)))
