"""A polite end: SIGTERM becomes an exception, so that an open log is finished like any other."""

from __future__ import annotations

import signal
from types import FrameType


class Terminated(SystemExit):
    """The process was asked to end (SIGTERM); the exit code is the shell's 128 + 15."""

    def __init__(self) -> None:
        super().__init__(128 + signal.SIGTERM)


def exit_on_sigterm() -> None:
    """Turn SIGTERM into `Terminated`, raised in the main thread. Call once, from the main thread."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise Terminated

    signal.signal(signal.SIGTERM, stop)
