"""Choice of the C++ compiler."""

from __future__ import annotations

import hashlib
import importlib.machinery
import importlib.util
import os
import stat
from pathlib import Path

import pytest

from fdi_torch.simulate import build


def test_a_packaged_compiler_is_the_last_resort(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "zig").write_text("")
    package = importlib.machinery.ModuleSpec("ziglang", None, is_package=True)
    package.submodule_search_locations = [str(tmp_path)]
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: package)
    on_path = build.find_compiler()
    monkeypatch.setenv("PATH", str(tmp_path / "nothing"))
    assert build.find_compiler() == (str(tmp_path / "zig"), "c++")
    assert on_path is None or on_path[0] != str(tmp_path / "zig")


SOURCE = 'extern "C" int answer() { return 42; }\n'


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    if build.find_compiler() is None:
        pytest.skip("no C++ compiler")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "fdi_torch"


def test_the_cache_is_of_one_user_alone_and_libraries_are_named_by_their_content(cache: Path) -> None:
    cache.mkdir(mode=0o755)
    cache.chmod(0o755)
    assert build.load_library(SOURCE, "answer").answer() == 42
    assert stat.S_IMODE(cache.stat().st_mode) == 0o700
    (library,) = cache.glob("*.so")
    assert library.stem.endswith(hashlib.sha256(library.read_bytes()).hexdigest())
    made = library.stat().st_mtime_ns
    assert build.load_library(SOURCE, "answer").answer() == 42
    assert [p.stat().st_mtime_ns for p in cache.glob("*.so")] == [made]


@pytest.mark.parametrize("damage", ["planted", "empty", "cut", "others may write", "a link"])
def test_a_library_that_is_not_the_one_built_is_built_anew(damage: str, cache: Path, tmp_path: Path) -> None:
    build.load_library(SOURCE, "answer")
    (library,) = cache.glob("*.so")
    whole = library.read_bytes()
    library.unlink()  # what this process has loaded stays as it is
    library.write_bytes(whole)
    library.chmod(0o700)
    if damage == "planted":
        library.write_bytes(b"\x7fELF another program" + whole)
    elif damage == "others may write":
        library.chmod(0o777)
    elif damage == "a link":
        library.rename(tmp_path / "elsewhere.so")
        library.symlink_to(tmp_path / "elsewhere.so")
    else:
        library.write_bytes(whole[: len(whole) // 2 if damage == "cut" else 0])
    damaged = library.stat(follow_symlinks=False)
    assert build.load_library(SOURCE, "answer").answer() == 42
    assert library.stat(follow_symlinks=False) != damaged
    (again,) = cache.glob("*.so")
    assert not again.is_symlink() and stat.S_IMODE(again.stat().st_mode) == 0o700
    assert again.stem.endswith(hashlib.sha256(again.read_bytes()).hexdigest())


def test_a_cache_that_is_a_link_is_refused(cache: Path, tmp_path: Path) -> None:
    (tmp_path / "theirs").mkdir()
    cache.symlink_to(tmp_path / "theirs")
    with pytest.raises(build.BuildError, match=r"has to be a folder that you own.* set XDG_CACHE_HOME"):
        build.load_library(SOURCE, "answer")


def test_a_library_without_its_function_is_told_in_a_sentence(cache: Path) -> None:
    with pytest.raises(build.BuildError, match=r"expected a compiled library with answer, got .*; set CXX"):
        build.load_library("int other;\n", "answer")


def test_without_a_home_there_is_a_cache_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(build.Path, "home", nowhere)
    assert build.cache_folder().name == f"fdi_torch_{os.geteuid()}"
