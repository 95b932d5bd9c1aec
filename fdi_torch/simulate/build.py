"""Compilation of C++ sources into shared libraries, with a cache that all processes of this user share.

A cached library is code that will be executed. Its folder therefore belongs to this user alone (mode 0700), its name
holds the hash of its content, and owner, mode and hash are checked before it is loaded. A library that fails the check
is compiled again.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib.util
import os
import platform
import shutil
import stat
import subprocess
import tempfile
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

_SHARED = ("-std=c++17", "-fPIC", "-shared", "-pthread")
_FLAGS = (
    *_SHARED, "-march=native", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast",
    "-fno-strict-aliasing",
)  # fmt: skip


REGISTER = Path(__file__).with_name("register.hpp")
"""Header with the width of a vector register, to be put before a source that needs it."""


class BuildError(OSError):
    """There is no C++ compiler, it rejected the source, or there is no writable folder for the result."""


Command = tuple[str, ...]


def find_compiler() -> Command | None:
    """$CXX if set, else the first of g++, c++ and clang++ on the PATH, else the compiler of the package ziglang; or
    None.
    """
    names = [os.environ["CXX"]] if os.environ.get("CXX") else ["g++", "c++", "clang++"]
    path = next((p for p in map(shutil.which, names) if p), None)
    return (path,) if path else _packaged_compiler()


def _packaged_compiler() -> Command | None:
    package = importlib.util.find_spec("ziglang")
    for folder in (package.submodule_search_locations or []) if package else []:
        if (Path(folder) / "zig").is_file():
            return str(Path(folder) / "zig"), "c++"
    return None


def warm_up() -> None:
    """Compile a small source, which makes a packaged compiler build its own library (a minute). Raises BuildError."""
    load_library("#include <thread>\n#include <vector>\nstd::vector<std::thread> threads;\n")


def can_compile() -> bool:
    try:
        warm_up()
    except BuildError:
        return False
    return True


def cache_folder() -> Path:
    """$XDG_CACHE_HOME/fdi_torch or ~/.cache/fdi_torch; without a home folder, one of this user in the temporary
    folder.
    """
    if os.environ.get("XDG_CACHE_HOME"):
        return Path(os.environ["XDG_CACHE_HOME"]) / "fdi_torch"
    try:
        return Path.home() / ".cache" / "fdi_torch"
    except RuntimeError:
        return Path(tempfile.gettempdir()) / f"fdi_torch_{os.geteuid()}"


def load_library(source: str, *functions: str, level: str = "-O3") -> ctypes.CDLL:
    """The compiled source, from the cache if possible. functions: names that it must export. level: of optimisation.
    Raises BuildError.
    """
    compiler = _expected_compiler()
    folder, key = _own_folder(), _key(compiler, source, level)
    cached = _cached(folder, key)
    if cached is not None:
        try:
            return _opened(cached, functions)
        except BuildError:
            cached.unlink(missing_ok=True)
    return _opened(_compile(compiler, source, level, folder, key), functions)


def compile_library(source: str, path: Path, flags: Sequence[str]) -> None:
    """Compile the source into a shared library at `path`, outside the cache. Raises BuildError."""
    with tempfile.TemporaryDirectory() as place:
        code = Path(place) / "library.cpp"
        code.write_text(source, encoding="utf-8")
        _run_compiler(_expected_compiler(), [*_SHARED, *flags], code, path)


def _expected_compiler() -> Command:
    compiler = find_compiler()
    if compiler is None:
        raise BuildError(
            "expected a C++ compiler, got none on the PATH; install g++, or fdi_torch[compiler], or set CXX"
        )
    return compiler


def _key(compiler: Command, source: str, level: str) -> str:
    key = "\0".join([source, *_FLAGS, level, _identity(compiler), _processor()])
    return hashlib.sha256(key.encode()).hexdigest()[:24]


def _own_folder() -> Path:
    """The cache folder, created if missing. Raises BuildError if another user owns it."""
    folder = cache_folder()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.lstat()
        if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.geteuid():
            raise BuildError(
                f"{folder}: the cache of compiled plants has to be a folder that you own, but another user owns it or "
                "it is a link; remove it, or set XDG_CACHE_HOME"
            )
        if stat.S_IMODE(status.st_mode) != 0o700:
            folder.chmod(0o700)
    except BuildError:
        raise
    except OSError as error:
        raise BuildError(f"expected to write to {folder}, got {error}; set XDG_CACHE_HOME") from error
    return folder


def _cached(folder: Path, key: str) -> Path | None:
    """The cached library of that key if it passes the check; libraries that fail it are removed."""
    for library in sorted(folder.glob(f"{key}_*.so")):
        if _is_sound(library):
            return library
        library.unlink(missing_ok=True)
    return None


def _is_sound(library: Path) -> bool:
    status = library.lstat()
    is_ours = stat.S_ISREG(status.st_mode) and status.st_uid == os.geteuid() and not status.st_mode & 0o022
    return is_ours and library.stem.rpartition("_")[2] == _content_hash(library)


def _content_hash(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _opened(library: Path, functions: Sequence[str]) -> ctypes.CDLL:
    try:
        opened = ctypes.CDLL(str(library))
        for name in functions:
            getattr(opened, name)
    except (OSError, AttributeError) as error:
        raise BuildError(
            f"expected a compiled library with {', '.join(functions)}, got {error}; set CXX to another compiler"
        ) from error
    return opened


def _compile(compiler: Command, source: str, level: str, folder: Path, key: str) -> Path:
    try:
        with tempfile.TemporaryDirectory(dir=folder) as place:
            code, built = Path(place) / "kernel.cpp", Path(place) / "kernel.so"
            code.write_text(source, encoding="utf-8")
            _run_compiler(compiler, (*_FLAGS, level), code, built)
            built.chmod(0o700)
            library = folder / f"{key}_{_content_hash(built)}.so"
            built.replace(library)  # atomic: other processes see all of it or nothing
            return library
    except BuildError:
        raise
    except OSError as error:
        raise BuildError(f"expected to write to {folder}, got {error}; set XDG_CACHE_HOME") from error


def _run_compiler(compiler: Command, flags: Sequence[str], code: Path, built: Path) -> None:
    done = subprocess.run([*compiler, *flags, str(code), "-o", str(built)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise BuildError(f"expected {' '.join(compiler)} to compile the plant, got: {done.stderr.strip()[:2000]}")


@lru_cache(maxsize=8)
def _identity(compiler: Command) -> str:
    status = os.stat(compiler[0])
    return f"{os.path.realpath(compiler[0])} {status.st_size} {status.st_mtime_ns}"


@lru_cache(maxsize=1)
def _processor() -> str:
    """The processor's description, on which `-march=native` depends."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return f"{platform.machine()} {platform.processor()} {platform.node()}"
    fields = ("model name", "flags", "Features", "CPU implementer", "CPU part")
    return "\n".join(dict.fromkeys(line for line in lines if line.startswith(fields)))
