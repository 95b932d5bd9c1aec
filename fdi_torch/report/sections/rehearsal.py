"""Section about the Monte Carlo validation of a monitor: its result tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fdi_torch.report.html import Markup, table, tag
from fdi_torch.report.material import Material
from fdi_torch.report.section import Section


def rehearsal_section(material: Material) -> Section | None:
    """Every table under its title."""
    blocks: list[Markup | str] = []
    for entry in rehearsal_tables(material):
        title, header, rows = (entry.get(name) for name in ("title", "header", "rows"))
        if isinstance(header, list) and isinstance(rows, list):
            complete = [row for row in rows if isinstance(row, list) and len(row) == len(header)]
            words = str(title)
            blocks += [tag("h4", words[:1].upper() + words[1:]), table(header, complete, _texts(complete))]
    return Section("Validation of the monitor", blocks) if blocks else None


def _texts(rows: Sequence[Sequence[Any]]) -> int:
    """Number of leading columns that hold no number, at least one."""
    columns = list(zip(*rows, strict=True))[1:]
    return 1 + next((k for k, column in enumerate(columns) if any(map(_number_in, column))), 0)


def _number_in(cell: Any) -> bool:
    return any(letter.isdigit() for letter in str(cell))


def rehearsal_tables(material: Material) -> list[dict[str, Any]]:
    """The tables in the log's result; empty if they are missing or unreadable."""
    if material.kind != "rehearsal":
        return []
    return [entry for entry in material.listed("tables") if isinstance(entry, dict)]
