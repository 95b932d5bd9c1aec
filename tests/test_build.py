"""Which compiler is taken."""

from __future__ import annotations

import importlib.machinery
import importlib.util
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
