"""Continuation of an interrupted run from its unfinished log."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

import numpy as np

from fdi_torch.logbook.errors import LogError, log_error
from fdi_torch.logbook.payload import unpack
from fdi_torch.logbook.reader import Run, read_run


def set_aside(path: str | Path) -> Path | None:
    """Rename the unfinished log of `NAME.mcap`, so that the run can be written again; None if there is none.

    The new name is NAME.mcap.partial.1, or the next free number. Raises LogError if its writer is still running.
    """
    partial = Path(f"{path}.partial")
    if not partial.exists():
        return None
    try:
        with open(partial, "rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            target = next(p for n in range(1, 10**6) if not (p := Path(f"{partial}.{n}")).exists())
            os.rename(partial, target)
    except BlockingIOError:
        raise LogError(f"{partial}: another run is writing this file; wait for it, or stop it") from None
    except OSError as error:
        raise log_error(partial, error) from error
    return target


def unfinished(path: str | Path) -> Run | None:
    """The unfinished log of `NAME.mcap`, renamed and opened; None if there is none."""
    aside = set_aside(path)
    return read_run(aside, salvage=True) if aside else None


def last_state(run: Run) -> tuple[int, dict[str, np.ndarray]] | None:
    """The last logged state of the search: generation and arrays; None if none was logged."""
    latest = None
    for message in run.messages(["/estimator/de/population"]):
        latest = message.payload
    return (int(latest["generation"]), unpack(latest)) if latest else None
