"""Keep freed memory in the process, to speed up fits of whole trajectories.

Such fits allocate and free the same few large arrays again and again. By default the GNU C library maps each of them
anew and the system clears every page, which takes a considerable part of a short run.
"""

from __future__ import annotations

import ctypes

KEPT = 1 << 30  # bytes of free memory to keep, and size up to which an array is kept
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of mallopt(3)


def keep_memory() -> bool:
    """Apply the setting to this process. Returns False if the C library does not support it."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # another C library; TypeError: Windows wants a name
        return False
    return bool(mallopt(_MMAP_THRESHOLD, KEPT)) and bool(mallopt(_TRIM_THRESHOLD, KEPT))
