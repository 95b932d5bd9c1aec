"""Progress of long work, reported to a function of the caller."""

from __future__ import annotations

from collections.abc import Callable

Tell = Callable[[float | None, str], None]
"""Receives the completed share, from 0 to 1 (None for work without a known end, as along a live source), and a line."""


def silent(share: float | None, text: str) -> None:
    """Ignore progress."""


def rounded(tell: Tell | None) -> Tell:
    """`tell` with shares of three decimals, which is as many as a reader needs; silent without `tell`."""
    tell_share = tell or silent
    return lambda share, text: tell_share(None if share is None else round(share, 3), text)
