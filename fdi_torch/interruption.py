"""Ctrl-C and SIGTERM as exceptions in the main thread, so that an open log can be completed.

An operation that must not be interrupted, such as a write to a log, runs inside `UNDISTURBED` (or holds a
`SteadyLock`): a signal that arrives meanwhile is raised at its end.
"""

from __future__ import annotations

import signal
import threading


class Terminated(SystemExit):
    """The process received SIGTERM; the exit code is the shell's 128 + 15."""

    def __init__(self) -> None:
        super().__init__(128 + signal.SIGTERM)


class _Undisturbed:
    """Reentrant context manager that postpones signals. It has no effect in other threads, where no signals are
    raised.
    """

    def __init__(self) -> None:
        self._main = threading.main_thread().ident
        self._depth = 0
        self._postponed: BaseException | None = None

    def __enter__(self) -> None:
        if threading.get_ident() == self._main:
            self._depth += 1

    def __exit__(self, *_: object) -> None:
        if threading.get_ident() == self._main:
            self._depth -= 1
            if self._postponed is not None and not self._depth:
                postponed, self._postponed = self._postponed, None
                raise postponed

    def raise_or_postpone(self, error: BaseException) -> None:
        if not self._depth:
            raise error
        self._postponed = error


UNDISTURBED = _Undisturbed()


class SteadyLock:
    """A reentrant lock; signals are postponed while the main thread holds the lock or waits for it."""

    def __init__(self) -> None:
        self._lock = threading.RLock()

    def __enter__(self) -> None:
        UNDISTURBED.__enter__()
        self._lock.acquire()

    def __exit__(self, *error: object) -> None:
        self._lock.release()
        UNDISTURBED.__exit__(*error)


def catch_signals() -> None:
    """Raise SIGTERM as `Terminated` and Ctrl-C as KeyboardInterrupt. Does nothing outside the main thread.

    Ctrl-C is left unchanged if the caller ignores or handles it.
    """
    if threading.current_thread() is not threading.main_thread():
        return
    signal.signal(signal.SIGTERM, lambda *_: UNDISTURBED.raise_or_postpone(Terminated()))
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, lambda *_: UNDISTURBED.raise_or_postpone(KeyboardInterrupt()))
