"""A rehearsal of a monitor: its tables, as the command prints them."""

from __future__ import annotations

from typing import Any

from fdi_torch.report.html import Markup, table, tag
from fdi_torch.report.material import Material
from fdi_torch.report.section import Section


def rehearsal_section(material: Material) -> Section | None:
    """Every table under its title."""
    blocks: list[Markup | str] = []
    for told in rehearsal_tables(material):
        title, header, rows = (told.get(name) for name in ("title", "header", "rows"))
        if isinstance(header, list) and isinstance(rows, list):
            whole = [row for row in rows if isinstance(row, list) and len(row) == len(header)]
            blocks += [tag("h4", str(title)), table(header, whole)]
    return Section("What the monitor did", blocks) if blocks else None


def rehearsal_tables(material: Material) -> list[dict[str, Any]]:
    """The tables of the log's result; none where it has none, or none that can be read."""
    if material.kind != "rehearsal":
        return []
    return [told for told in material.listed("tables") if isinstance(told, dict)]
