"""Fixtures of the logbook's tests."""

from __future__ import annotations

from pathlib import Path

import pytest
from example_logs import write_finished


@pytest.fixture
def finished(tmp_path: Path) -> Path:
    """A finished log with every topic in it."""
    return write_finished(tmp_path / "run.mcap")
