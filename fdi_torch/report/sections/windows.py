"""Section about a window-by-window fit: when each suspected fault was present, and how large."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from matplotlib.figure import Figure

from fdi_torch.amounts import parameter_words, with_error
from fdi_torch.quantities import quantity_text
from fdi_torch.report.html import short, shown
from fdi_torch.report.material import Material
from fdi_torch.report.numbers import as_float, number
from fdi_torch.report.section import Picture, Section
from fdi_torch.report.style import FAINT, MARK, panel
from fdi_torch.tables import Table, in_display_unit

Records = list[dict[str, Any]]
MOST_SUSPECTS = 40
LARGEST_RELATIVE_ERROR = 10.0  # a size with a larger standard error is not shown as a number


def windows_section(material: Material) -> Section | None:
    """A bar for each period in which a fault was present, and its size."""
    windows, stretches = logged_windows(material)
    if not windows:
        return None
    count = f"{len(windows)} windows, each" if len(windows) > 1 else "One window,"
    words = f"{count} fitted separately; neighbouring windows with the same fault are one period."
    listed = shown(replace(period_table(stretches), title="")) if stretches else "No fault was present in any window."
    caption = "When each fault was present (dark), and where its window does not determine it (pale)."
    return Section(
        "Window by window", [words, [Picture("windows", _bars(windows), caption, wide=True)], listed], lead=True
    )


def period_table(stretches: Sequence[Mapping[str, Any]]) -> Table:
    """One row per period in which a fault was present, from the fields of `Stretch`."""
    rows = []
    for stretch in stretches:
        flow = as_float(stretch.get("flow"))
        shown_flow = quantity_text(flow, "m^3/s", 3) if math.isfinite(flow) else ""
        times = (number(stretch[name], 6) for name in ("start", "stop"))
        rows.append([parameter_words(str(stretch["name"])), *times, size_text(stretch), shown_flow])
    return Table(("fault", "from, s", "to, s", "size", "flow"), rows, "present")


def size_text(fault: Mapping[str, Any]) -> str:
    """Size and standard error in the unit for display; '> ' and the size if its error is too large to show it."""
    name, si_unit = str(fault["name"]), str(fault.get("unit", "1"))
    unit, size, std = in_display_unit(name, si_unit, as_float(fault.get("size")), as_float(fault.get("std")))
    known = std < LARGEST_RELATIVE_ERROR * max(abs(size), 1.0)
    return f"{with_error(size, std) if known else f'> {number(size)}'} {unit.removeprefix('1')}".rstrip()


def _bars(windows: Sequence[dict[str, Any]]) -> Figure:
    suspects = [name for name, entry in windows[0].items() if isinstance(entry, dict)][:MOST_SUSPECTS]
    figure, axes = panel("", "time, s", "", height=0.8 + 0.28 * len(suspects))
    for row, name in enumerate(suspects):
        for state, strength in (("present", 1.0), ("cannot tell", 0.25)):
            spans = [
                (float(w["start"]), float(w["stop"]) - float(w["start"]))
                for w in windows
                if isinstance(w.get(name), dict) and w[name].get("state") == state
            ]
            axes.broken_barh(spans, (row - 0.35, 0.7), facecolors=MARK, alpha=strength, edgecolor="none")
        axes.axhline(row, color=FAINT, linewidth=0.5, zorder=0)
    axes.set_yticks(range(len(suspects)), [short(parameter_words(name)) for name in suspects])
    axes.set_ylim(len(suspects) - 0.5, -0.5)
    axes.set_xlim(float(windows[0]["start"]), max(float(w["stop"]) for w in windows))
    axes.grid(False)
    return figure


def logged_windows(material: Material) -> tuple[Records, Records]:
    """Windows, and the periods in which a fault was present; empty if they are missing or unreadable."""
    windows, stretches = (
        [each for each in material.listed(name) if isinstance(each, dict) and {"start", "stop"} <= _numbers_of(each)]
        for name in ("windows", "stretches")
    )
    return windows, [stretch for stretch in stretches if isinstance(stretch.get("name"), str)]


def _numbers_of(record: dict[str, Any]) -> set[str]:
    return {name for name, value in record.items() if isinstance(value, int | float)}
