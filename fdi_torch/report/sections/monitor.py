"""Sections about a monitor: residuals, test statistics with their thresholds, and all events."""

from __future__ import annotations

import numpy as np

from fdi_torch.report.chart import Chart, Line
from fdi_torch.report.html import table
from fdi_torch.report.material import Material
from fdi_torch.report.numbers import axis, number, raised, shown_unit
from fdi_torch.report.section import Section, signals
from fdi_torch.report.style import MARK, MODEL

RESIDUAL, ALARM = "/observer/residual", "/observer/alarm"
_SUFFIXES = ("_statistic", "_threshold")


def residual_section(material: Material) -> Section | None:
    """The residual of each sensor, with the alarms."""
    columns, time = material.residuals, material.residuals.get("t", np.zeros(0))
    if not len(time):
        return None
    alarms, pictures = _alarms(material), []
    for k, name in enumerate(name for name in columns if name != "t" and not name.endswith(_SUFFIXES)):
        unit, scale = shown_unit(material.unit(RESIDUAL, name), name)
        line, label = Line("measured − predicted", time, scale * columns[name], MODEL), axis("residual", unit)
        chart = Chart(name, "time, s", label, [line], level=0.0, events=alarms, clock="monitor", height=2.1)
        pictures.append(signals(f"observer_residual_{k + 1}", chart))
    return Section("Residuals", ["Vertical lines: alarms.", pictures]) if pictures else None


def statistic_section(material: Material) -> Section | None:
    """Each test statistic with its threshold and the alarms."""
    columns, time = material.residuals, material.residuals.get("t", np.zeros(0))
    alarms, pictures = _alarms(material), []
    for k, name in enumerate(name for name in columns if name.endswith("_statistic")):
        channel = name.removesuffix("_statistic")
        limit = columns.get(f"{channel}_threshold")
        lines = [Line("statistic", time, columns[name], MODEL)]
        lines += [] if limit is None else [Line("threshold", time, limit, MARK, dashed=True)]
        title = f"Test statistic, {'all sensors' if channel == 'all' else channel}"
        chart = Chart(title, "time, s", "statistic (no unit)", lines, log=True, events=alarms, clock="monitor")
        pictures.append(signals(f"observer_statistic_{k + 1}", chart))
    words = "Vertical lines: alarms. Dashed: thresholds." if alarms else "Dashed: thresholds. No alarm was raised."
    return Section("Detection", [words, pictures], lead=True) if pictures else None


def _alarms(material: Material) -> list[float]:
    """Times of the alarms, s."""
    return [float(m["t"]) for m in material.of(ALARM) if m.get("event") in ("alarm", "raised")]


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
            raised(str(m.get("message", ""))),
            number(float(m["onset"]), 6) if isinstance(m.get("onset"), int | float) else "",
        ]
        for m in events
    ]
    listed = table(("time, s", "event", "at", "description", "onset, s"), rows, left=4)
    return Section("Events", [listed])
