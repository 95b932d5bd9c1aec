"""Import of the libraries of the extras for live sources."""

from __future__ import annotations

from typing import Any

from fdi_torch.tables import needed


def library_of(extra: str, name: str) -> Any:
    """The library. Raises ValueError, with the command that installs it, if it is missing."""
    try:
        return needed(name, extra)
    except ImportError as error:
        raise ValueError(str(error)) from error
