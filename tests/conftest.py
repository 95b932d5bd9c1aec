"""What the tests share: where real recordings lie."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from fdi_torch.quantities import displayed_in


def pytest_addoption(parser: pytest.Parser) -> None:
    told = "how long the slow test draws files that a person or an attacker could write"
    parser.addoption("--fuzz-minutes", type=float, default=0.5, help=told)
    parser.addoption("--fuzz-seed", type=int, default=2, help="the seed of the first round of these files")
    parser.addoption("--kills", type=int, default=6, help="how often the slow test kills each of five jobs")


@pytest.fixture(autouse=True)
def _default_units() -> Iterator[None]:
    """Units for display that a test sets end with it."""
    with displayed_in({}):
        yield


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real recordings; tests that need it are skipped where it is absent."""
    here = Path(__file__).resolve().parents[1]
    for folder in (os.environ.get("FDI_TORCH_DATA"), here.parent / "shared" / "data"):
        if folder and Path(folder).is_dir():
            return Path(folder)
    pytest.skip("no real recordings: set FDI_TORCH_DATA")
