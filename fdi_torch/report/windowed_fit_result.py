"""Result of a window-by-window fit in a log. The file is untrusted input."""

from __future__ import annotations

from typing import Any

from fdi_torch.report.material import Material

Records = list[dict[str, Any]]


def logged_windows(material: Material) -> tuple[Records, Records]:
    """Windows, and the periods in which a fault was present; empty if they are missing or unreadable."""
    windows, stretches = (_records(material, name) for name in ("windows", "stretches"))
    return [w for w in windows if _spans(w)], [s for s in stretches if _spans(s) and isinstance(s.get("name"), str)]


def _records(material: Material, name: str) -> Records:
    return [each for each in material.listed(name) if isinstance(each, dict)]


def _spans(record: dict[str, Any]) -> bool:
    return all(isinstance(record.get(name), int | float) for name in ("start", "stop"))
