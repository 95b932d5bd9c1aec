"""The README's session prints what the README shows."""

from __future__ import annotations

from pathlib import Path

from fdi_torch import load_run
from tests.sessions import check, run_page

README = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")


def test_the_readme_is_short() -> None:
    assert len(README.splitlines()) <= 120


def test_the_session_prints_what_is_shown(here: Path) -> None:
    run_page(README, check)
    assert load_run("leak.yaml").plant.name == "three_tank"
    assert not load_run("leak.yaml").plant.effects
    assert load_run("leak.yaml", ["plant=better.yaml"]).plant.effects
