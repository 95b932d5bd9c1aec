"""Sections about a monitor: residuals with thresholds and alarms, and all events."""

from __future__ import annotations

import numpy as np

from fdi_torch.report.html import table
from fdi_torch.report.material import Material
from fdi_torch.report.numbers import axis, number, shown_unit
from fdi_torch.report.panels import residual_panel
from fdi_torch.report.section import Picture, Section

RESIDUAL, ALARM = "/observer/residual", "/observer/alarm"
_SUFFIXES = ("_statistic", "_threshold")


def residual_section(material: Material) -> Section | None:
    """One panel per channel for the residual, and one for the test statistic with its threshold."""
    columns = dict(material.residuals)
    time = columns.pop("t", np.zeros(0))
    if not len(time):
        return None
    alarms = [float(m["t"]) for m in material.of(ALARM) if m.get("event") in ("alarm", "raised")]
    pictures, tests = [], []
    for k, name in enumerate(name for name in columns if not name.endswith(_SUFFIXES)):
        unit, scale = shown_unit(material.unit(RESIDUAL, name))
        figure = residual_panel(name, axis("read − observer", unit), time, scale * columns[name], events=alarms)
        pictures.append(Picture(f"observer_residual_{k + 1}", figure))
    for k, name in enumerate(name for name in columns if name.endswith("_statistic")):
        channel = name.removesuffix("_statistic")
        limit = columns.get(f"{channel}_threshold")
        limits = [] if limit is None else [limit]
        figure = residual_panel(f"{channel}: test", "statistic", time, columns[name], limits, alarms)
        tests.append(Picture(f"observer_statistic_{k + 1}", figure))
    words = "Vertical lines: alarms. Dashed: thresholds." if alarms else "Dashed: thresholds. No alarm was raised."
    return Section("Residuals", [words, pictures, *([tests] if tests else [])])


def event_section(material: Material) -> Section | None:
    """All events of the monitor."""
    events = material.of(ALARM)
    if not events:
        return None
    rows = [
        [
            number(float(m["t"]), 6),
            str(m.get("event", "")),
            str(m.get("channel", "")),
            str(m.get("message", "")),
            number(float(m["onset"]), 6) if isinstance(m.get("onset"), int | float) else "",
        ]
        for m in events
    ]
    return Section("Events", [table(("time, s", "event", "at", "description", "onset, s"), rows, left=4)])
