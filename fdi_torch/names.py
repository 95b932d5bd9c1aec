"""Matching of requested names with known ones, and messages for those that do not match."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from difflib import SequenceMatcher
from fnmatch import fnmatchcase

MOST_SHOWN = 80
MOST_SIMILAR = 3
MISSPELT = (
    0.75  # share of the letters of two names that agree (difflib's ratio), above which one is the other, misspelt
)
_WORDS = re.compile(r"[^\W_]+")
_LAST = re.compile(r"(?:0*([0-9]+)|(?:^|[\W_0-9]|(?<=[a-z])(?=[A-Z]))([A-Za-z])|^[A-Z]{1,2}([A-Z]))\W*$")


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
    near = [f"'{shortened(each)}'" for each in similar(name, known)]
    return f"; the nearest {'is' if len(near) == 1 else 'are'} {listed(near)}" if near else ""


def similar(name: str, known: Iterable[str]) -> list[str]:
    """At most `MOST_SIMILAR` known names that may be meant: a part of the words given, or more, or else misspelt."""
    name, distinct = name[:MOST_SHOWN].lower(), list(dict.fromkeys(known))
    alike = {each: SequenceMatcher(None, name, each.lower()).ratio() for each in distinct}
    most = max(alike.values(), default=0.0)
    related = [each for each in distinct if _shares_words(name, each.lower())]
    misspelt = [each for each in distinct if alike[each] == most >= MISSPELT]
    return (related or misspelt)[:MOST_SIMILAR]


def _shares_words(name: str, known: str) -> bool:
    """Whether one begins with the other, or has all words of the other."""
    words, known_words = set(_WORDS.findall(name)), set(_WORDS.findall(known))
    begins = bool(name) and (known.startswith(name) or name.startswith(known))
    return begins or (bool(words and known_words) and (words <= known_words or known_words <= words))


def distinguishing_end(name: str) -> str:
    """The number or the single letter at the end of a name: 'Pump 01' -> '1', 'LA', 'hA' and 'level a' -> 'A'; '' if
    the name ends in a word.
    """
    match = _LAST.search(name)
    return next(filter(None, match.groups())).upper() if match else ""


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
