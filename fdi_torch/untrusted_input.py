"""Limits on untrusted input (recordings, plants, run files, logs), and safe display of its text.

A small file can demand more memory than a machine has: by aliases, by compression, or by a number that is a size. Every
reader checks these limits before it allocates.
"""

from __future__ import annotations

import re

MOST_YAML_BYTES = 2**20
MOST_YAML_VALUES = 100_000
"""Values of a YAML document with its aliases and merge keys expanded."""
MOST_DIGITS = 400
"""Digits of one number in a YAML document."""
MOST_COMPONENTS = 500
"""Total number of tanks, pipes, pumps, sensors and effects of a plant."""
MOST_SAMPLES = 10**8
"""Samples of one recording."""
MOST_SETTINGS, MOST_TRIALS = 4096, 10**6
"""Settings of a study, and the total number of trials."""
MOST_LINE = 2**20
"""Characters in a line of a CSV file."""
MOST_UNPACKED, MOST_EXPANSION = 3 * 2**23, 50
"""Maximum size of an unpacked recording, bytes, and maximum expansion factor; the larger limit applies."""
MOST_SHEET, MOST_SHEET_EXPANSION = 3 * 2**22, 15
"""The same for an Excel workbook; a logger's columns expand 8 times, and reading them is slow."""
MOST_ARRAY_BYTES, MOST_ARRAY_EXPANSION = 2**26, 50
"""The same for the arrays in a log."""

_UNSHOWN = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200b\u200e\u200f\u2028-\u202e\u2060-\u2069\ufeff\ud800-\udfff]"
)


def printable(text: str) -> str:
    """Text that is safe for a terminal: control, colour, invisible and direction characters are escaped."""
    return _UNSHOWN.sub(lambda match: match[0].encode("unicode_escape").decode("ascii"), text)


def printable_json(text: str) -> str:
    """JSON text that is safe for a terminal and has the same meaning."""
    return _UNSHOWN.sub(lambda match: f"\\u{ord(match[0]):04x}", text)


def expect_unpacked(unpacked: int, packed: int, source: str, most: int, expansion: int) -> None:
    """Raises ValueError if the unpacked size exceeds both limits."""
    allowed = max(most, expansion * packed)
    if unpacked > allowed:
        raise ValueError(
            f"{source}: expected at most {allowed} bytes once unpacked, got more out of {packed}; "
            "if you trust the file, unpack it yourself"
        )
