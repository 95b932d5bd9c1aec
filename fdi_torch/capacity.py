"""The memory limit of the machine: larger work is refused before anything is allocated."""

from __future__ import annotations

import os
import resource
from functools import lru_cache
from pathlib import Path

NUMBER = 8
"""Bytes of a float64 number."""
_CONTROL_GROUP = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")


@lru_cache(maxsize=1)
def memory() -> int:
    """The machine's memory, or the smaller limit of this process or its container, bytes."""
    limits = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    for name in _CONTROL_GROUP:
        try:
            text = Path(name).read_text(encoding="ascii").strip()
        except OSError:
            continue
        limits += [int(text)] if text.isdigit() else []
    allowed, _ = resource.getrlimit(resource.RLIMIT_AS)
    return min(limits + ([] if allowed == resource.RLIM_INFINITY else [allowed]))


def expect_room(numbers: float, what: str, remedy: str) -> None:
    """Raises ValueError if that many numbers exceed the memory limit. what: the work that needs them, in words."""
    if not NUMBER * numbers <= memory():
        raise ValueError(
            f"expected work that fits into the {1e-9 * memory():.3g} GB of memory here, got {what}, which takes "
            f"{1e-9 * NUMBER * numbers:.3g} GB at least; {remedy}"
        )
