"""What comes from outside (recordings, plants, run files, logs): how much of it is taken, and how its text is shown.

A file may ask for more than a machine has: by aliases, by compression, by a number that is a size. Every reader asks
here how much that may be, and refuses the file before it takes the memory.
"""

from __future__ import annotations

import re

MOST_YAML_BYTES = 2**20
MOST_YAML_VALUES = 100_000
"""Values of a YAML document with its aliases and merge keys spelled out."""
MOST_DIGITS = 400
"""Digits of one number in a YAML document."""
MOST_COMPONENTS = 500
"""Tanks, pipes, pumps, sensors and effects of a plant, together."""
MOST_SAMPLES = 10**8
"""Samples of one recording."""
MOST_SETTINGS, MOST_TRIALS = 4096, 10**6
"""Settings of a study, and trials of all of them together."""
MOST_LINE = 2**20
"""Characters in a line of a CSV file."""
MOST_UNPACKED, MOST_EXPANSION = 3 * 2**23, 50
"""A compressed recording becomes at most so many bytes, or so many times as long as it is, whichever is more."""
MOST_SHEET, MOST_SHEET_EXPANSION = 3 * 2**22, 15
"""The same of an Excel workbook, where a logger's columns come to 8 times, and reading takes longest."""
MOST_ARRAY_BYTES, MOST_ARRAY_EXPANSION = 2**26, 50
"""The same of the arrays in a log."""

_UNSHOWN = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200b\u200e\u200f\u2028-\u202e\u2060-\u2069\ufeff\ud800-\udfff]"
)


def printable(text: str) -> str:
    """Text as it may go to a terminal: what would move the cursor, colour, hide or turn words is spelled out."""
    return _UNSHOWN.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), text)


def printable_json(text: str) -> str:
    """JSON text as it may go to a terminal; it says the same."""
    return _UNSHOWN.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def expect_unpacked(unpacked: int, packed: int, source: str, most: int, expansion: int) -> None:
    """Raises ValueError where something compressed becomes larger than it may."""
    allowed = max(most, expansion * packed)
    if unpacked > allowed:
        raise ValueError(
            f"{source}: expected at most {allowed} bytes once unpacked, got more out of {packed}; "
            "unpack it yourself where it is what it seems"
        )
