"""Progress of a job, reported to a function of the caller."""

from __future__ import annotations

from collections.abc import Callable

Tell = Callable[[float, str], None]
"""Receives the completed share of a job, from 0 to 1, and a line about it."""
TellEndless = Callable[[float | None, str], None]
"""As `Tell`, but the share is None for a job without a known end, such as one along a live source."""
DIGITS = 3
"""Decimals of a share."""


def silent(share: float | None, text: str) -> None:
    """Ignore progress."""


def rounded(tell: Callable[..., None] | None) -> TellEndless:
    """`tell` with shares of `DIGITS` decimals, which is as many as a reader needs; silent without `tell`."""
    tell_share = tell or silent
    return lambda share, text: tell_share(None if share is None else round(share, DIGITS), text)
