"""What the tests share: where real recordings lie."""

from __future__ import annotations

import gc
import io
import json
import os
from collections.abc import Iterator
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import pytest

from fdi_torch.quantities import displayed_in


def pytest_addoption(parser: pytest.Parser) -> None:
    told = "how long the slow test draws files that a person or an attacker could write"
    parser.addoption("--fuzz-minutes", type=float, default=0.5, help=told)
    parser.addoption("--fuzz-seed", type=int, default=2, help="the seed of the first round of these files")
    parser.addoption("--kills", type=int, default=6, help="how often the slow test kills each of five jobs")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Collect tests without garbage collections, which find none: what is imported, and the tests, stay to the end."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.fixture(autouse=True)
def _default_units() -> Iterator[None]:
    """Units for display that a test sets end with it."""
    with displayed_in({}):
        yield


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, in which the test runs."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real recordings; tests that need it are skipped where it is absent."""
    here = Path(__file__).resolve().parents[1]
    for folder in (os.environ.get("FDI_TORCH_DATA"), here.parent / "shared" / "data"):
        if folder and Path(folder).is_dir():
            return Path(folder)
    pytest.skip("no real recordings: set FDI_TORCH_DATA")


@pytest.fixture(scope="session")
def watched(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict[str, Any]]]:
    """Folder, with the log in `logs`, and events of one run of the monitor along the recording of
    `test_monitor_follow`.
    """
    from fdi_torch.cli import main
    from tests.test_monitor_follow import config, written

    folder, printed = tmp_path_factory.mktemp("watched"), io.StringIO()
    written(folder / "rig.csv")
    with redirect_stdout(printed):
        assert main(["monitor", "--config", config(folder), "--json", "--quiet"]) == 0
    return folder, [json.loads(line) for line in printed.getvalue().splitlines()]
