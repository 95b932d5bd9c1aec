"""Every script of docs/gallery runs and draws its picture, is short, and uses the public interface only."""

from __future__ import annotations

import ast
import os
import runpy
import shutil
import sys
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import pytest

import fdi_torch

ROOT = Path(__file__).resolve().parents[1]
GALLERY = ROOT / "docs" / "gallery"
SCRIPTS = sorted(path.stem for path in GALLERY.glob("*.py") if path.stem != "style")
LINES = 60


def test_there_are_ten_scripts_with_pictures_on_the_page() -> None:
    page = (GALLERY / "README.md").read_text(encoding="utf-8")
    assert len(SCRIPTS) == 10
    for name in SCRIPTS:
        assert f"]({name}.py)" in page and f"]({name}.png)" in page and (GALLERY / f"{name}.png").is_file()


@pytest.mark.parametrize("name", SCRIPTS)
def test_scripts_are_short_and_use_public_names(name: str) -> None:
    text = (GALLERY / f"{name}.py").read_text(encoding="utf-8")
    assert len(text.splitlines()) < LINES
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("fdi_torch"):
            assert node.module == "fdi_torch" and {alias.name for alias in node.names} <= set(fdi_torch.__all__)
        elif isinstance(node, ast.Import):
            assert not any(alias.name.startswith("fdi_torch.") for alias in node.names)
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "fdi_torch":
            assert node.attr in fdi_torch.__all__


@pytest.mark.slow
@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_draws_its_picture(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "docs" / "gallery"
    shutil.copytree(GALLERY, folder, ignore=shutil.ignore_patterns("*.png", "__pycache__"))
    shutil.copytree(ROOT / "configs", tmp_path / "configs")
    monkeypatch.setenv("FDI_TORCH_DATA", os.environ.get("FDI_TORCH_DATA", str(ROOT.parent / "shared" / "data")))
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(folder)  # where a script finds style.py
    monkeypatch.delitem(sys.modules, "style", raising=False)
    with matplotlib.rc_context():
        try:
            runpy.run_path(str(folder / f"{name}.py"), run_name="__main__")
        except SystemExit as end:
            assert not end.code
        finally:
            plt.close("all")
    said = capsys.readouterr().out
    if name == "real_rig" and said.startswith("skipped"):
        pytest.skip(said.strip())
    assert (folder / f"{name}.png").stat().st_size > 10_000
