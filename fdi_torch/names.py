"""Names asked for and names there are: what is said where the two do not meet."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable
from fnmatch import fnmatchcase

MOST_SHOWN = 80


def shortened(text: str) -> str:
    """A text for a message: cut off where it is long."""
    return text if len(text) <= MOST_SHOWN else f"{text[: MOST_SHOWN - 3]}..."


def nearest(name: str, known: Iterable[str]) -> str:
    """'; the nearest is X', or nothing where no known name is near."""
    near = difflib.get_close_matches(name[:MOST_SHOWN], list(known), n=1, cutoff=0.5)
    return f"; the nearest is '{near[0]}'" if near else ""


def unknown(kind: str, name: str, known: Iterable[str]) -> str:
    """The sentence for a name that is not among the known ones."""
    known = list(known)
    return f"expected {kind} ({', '.join(known) or 'there are none'}), got '{shortened(name)}'{nearest(name, known)}"


def matching(kind: str, patterns: Iterable[str], known: Collection[str]) -> list[str]:
    """The known names that the patterns ask for (* is any name), each once. Raises ValueError for a pattern that asks
    for none.
    """
    found: dict[str, None] = {}
    for pattern in patterns:
        fitting = [name for name in known if fnmatchcase(name, pattern)]
        if not fitting:
            raise ValueError(unknown(kind, pattern, known))
        found |= dict.fromkeys(fitting)
    return list(found)
