"""What is freed is kept for the next array of its size, instead of going back to the system and being cleared again.

Fits of whole trajectories make and drop the same few large arrays all the time. The GNU C library maps each of them
anew by default, and the system clears every page: a good part of a short run. Elsewhere nothing is changed.
"""

from __future__ import annotations

import ctypes

KEPT = 1 << 30  # bytes that may lie idle; the most an array may have to be kept
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of mallopt(3)


def keep_memory() -> bool:
    """From now on, in this process. Returns whether the C library can do it."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # another C library; TypeError: Windows wants a name
        return False
    return bool(mallopt(_MMAP_THRESHOLD, KEPT)) and bool(mallopt(_TRIM_THRESHOLD, KEPT))
