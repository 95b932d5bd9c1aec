"""Matching of requested names with known ones, and messages for those that do not match."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable, Sequence
from fnmatch import fnmatchcase

MOST_SHOWN = 80


def shortened(text: str) -> str:
    """A text for a message, cut to `MOST_SHOWN` characters."""
    return text if len(text) <= MOST_SHOWN else f"{text[: MOST_SHOWN - 3]}..."


def listed(items: Sequence[str], word: str = "and") -> str:
    """'a', 'a and b', 'a, b and c'; '' for no items."""
    return f" {word} ".join(part for part in (", ".join(items[:-1]), *items[-1:]) if part)


def counted(number: int, noun: str) -> str:
    """'1 gap', '2 gaps'."""
    return f"{number} {noun}" + ("" if number == 1 else "s")


def nearest(name: str, known: Iterable[str]) -> str:
    """'; the nearest is X', or an empty text if no known name is similar."""
    near = difflib.get_close_matches(name[:MOST_SHOWN], list(known), n=1, cutoff=0.5)
    return f"; the nearest is '{near[0]}'" if near else ""


def unknown(kind: str, name: str, known: Iterable[str]) -> str:
    """The message for an unknown name."""
    known = list(known)
    return f"expected {kind} ({', '.join(known) or 'there are none'}), got '{shortened(name)}'{nearest(name, known)}"


def matching(kind: str, patterns: Iterable[str], known: Collection[str]) -> list[str]:
    """The known names that match the patterns (* is any name), each once. Raises ValueError for a pattern without a
    match.
    """
    matches: dict[str, None] = {}
    for pattern in patterns:
        matched = [name for name in known if fnmatchcase(name, pattern)]
        if not matched:
            raise ValueError(unknown(kind, pattern, known))
        matches |= dict.fromkeys(matched)
    return list(matches)
