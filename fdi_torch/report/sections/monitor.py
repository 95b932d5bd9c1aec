"""Sections about a monitor: residuals, test statistics with their thresholds, all events, and the tables of its Monte
Carlo validation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import orjson

from fdi_torch.amounts import faults_in_words, percent_text, rounded
from fdi_torch.clock import clock_text
from fdi_torch.names import listed
from fdi_torch.report.chart import FLAT, Chart, Line
from fdi_torch.report.html import Markup, bullets, shown, table, tag, unbroken
from fdi_torch.report.material import Material, Payload
from fdi_torch.report.numbers import as_float, number
from fdi_torch.report.section import Section, channel_signals, signals
from fdi_torch.report.style import MARK, MODEL
from fdi_torch.tables import Table

RESIDUAL, ALARM = "/observer/residual", "/observer/alarm"
_SUFFIXES = ("_statistic", "_threshold")
NAMES = {"all": "all sensors", "cusum": "CUSUM", "fixed": "fixed threshold"}


def residual_section(material: Material) -> Section | None:
    """The residual of each sensor, with the alarms."""
    columns, time = material.residuals, material.residuals.get("t", np.zeros(0))
    if not len(time):
        return None
    alarms, marks, pictures = _alarms(material), adoptions(material), []
    for k, name in enumerate(name for name in columns if name != "t" and not name.endswith(_SUFFIXES)):
        unit, lines = material.unit(RESIDUAL, name), [Line("measured − predicted", time, columns[name], MODEL)]
        about: dict[str, Any] = {"level": 0.0, "events": alarms, "marks": marks, "clock": "monitor", "height": FLAT}
        about |= {
            "name": f"observer_residual_{k + 1}",
            "title": material.channel_words(name),
            "label": "measured − predicted",
        }
        pictures.append(channel_signals(si_unit=unit, lines=lines, channel=name, **about))
    words = f"Vertical lines: alarms.{mark_words(marks, 'the residuals are')}"
    return Section("Residuals", [words, pictures]) if pictures else None


def statistic_section(material: Material) -> Section | None:
    """Each test statistic with its threshold and the alarms."""
    columns, time = material.residuals, material.residuals.get("t", np.zeros(0))
    alarms, marks, pictures = _alarms(material), adoptions(material), []
    for k, name in enumerate(name for name in columns if name.endswith("_statistic")):
        channel = name.removesuffix("_statistic")
        limit = columns.get(f"{channel}_threshold")
        lines = [Line("statistic", time, columns[name], MODEL)]
        lines += [] if limit is None else [Line("threshold", time, limit, MARK, dashed=True)]
        title = f"Test statistic, {NAMES.get(channel) or material.channel_words(channel)}"
        chart = Chart(
            title, "time, s", "statistic (no unit)", lines, log=True, events=alarms, marks=marks, clock="monitor"
        )
        pictures.append(signals(f"observer_statistic_{k + 1}", chart))
    words = "Vertical lines: alarms. Dashed: thresholds." if alarms else "Dashed: thresholds. No alarm was raised."
    words += mark_words(marks, "the statistics are")
    return Section("Detection", [words, pictures], lead=True) if pictures else None


def _alarms(material: Material) -> list[float]:
    """Times of the alarms, s."""
    return [float(m["t"]) for m in material.of(ALARM) if m.get("event") in ("alarm", "raised")]


def adoptions(material: Material) -> list[tuple[float, str]]:
    """Time, s, and words of each change of the faults that the monitor's model contains: 'leak at A adopted'."""
    held: tuple[str, ...] = ()
    changes: list[tuple[float, str]] = []
    for message in material.of(ALARM):
        now = _believed(message)
        if now is not None and now != held:
            words = f"{listed(faults_in_words(now))} adopted" if now else f"{listed(faults_in_words(held))} dropped"
            changes.append((float(message["t"]), words))
            held = now
    return changes


def _believed(message: Payload) -> tuple[str, ...] | None:
    """Names of the sizes of the faults that the monitor's model contains after an event; None if the log lacks them."""
    try:
        return tuple(sorted(str(name) for name, _ in orjson.loads(message.get("details", ""))["believed"]))
    except (KeyError, TypeError, ValueError):
        return None


def mark_words(marks: Sequence[tuple[float, str]], what: str) -> str:
    """The sentence about the dashed lines of `adoptions`; empty without any."""
    return f" Thin dashed lines: from there on {what} those of the model with the fault named." if marks else ""


def event_section(material: Material) -> Section | None:
    events = material.of(ALARM)
    if not events:
        return None
    header = ("time, s", "clock time", "event", "description", "onset, s", "onset, clock time")
    return Section("Events", [table(header, [_event_cells(m) for m in events], left=4)])


def _event_cells(event: Payload) -> list[Any]:
    """Cells of an event, empty where it has no onset or the recording has no dates."""
    time, onset, std = (as_float(event.get(name)) for name in ("t", "onset", "onset_std"))
    # A span of this class is not broken into two lines.
    kind, *moments = (
        tag("span", text, class_="moment") if text else ""
        for text in (event.get("event", ""), clock_text(time), clock_text(onset))
    )
    onsets = ["", ""] if math.isnan(onset) else [rounded(onset, std), moments[1]]
    return [number(time, 6), moments[0], kind, _description(event), *onsets]


def _description(event: Payload) -> Markup:
    """The message, each of its statements on a line, and several explanations of an alarm as a list of all."""
    message, names = str(event.get("message", "")), event.get("explanations")
    rivals = list(zip(names, event.get("masses") or (), strict=False)) if isinstance(names, list) else []
    before, named, after = message.partition(str(event.get("headline") or message))
    if named and len(rivals) > 1:
        items = [unbroken(f"{text}, {percent_text(as_float(mass))}") for text, mass in rivals]
        return tag("div", before, *bullets(items), *_lines(after))
    return tag("div", *_lines(message))


def _lines(message: str) -> list[Markup]:
    parts = message.removeprefix(", ").removeprefix("; ").split("; ")
    return [tag("div", unbroken(part)) for part in parts if part]


def rehearsal_section(material: Material) -> Section | None:
    """Every table under its title."""
    blocks: list[Markup] = []
    for entry in rehearsal_tables(material):
        title, header, rows = (entry.get(name) for name in ("title", "header", "rows"))
        if isinstance(header, list) and isinstance(rows, list):
            complete = [row for row in rows if isinstance(row, list) and len(row) == len(header)]
            blocks.append(shown(Table(header, complete, str(title))))
    return Section("Validation of the monitor", blocks) if blocks else None


def rehearsal_tables(material: Material) -> list[dict[str, Any]]:
    """The tables in the log's result; empty if they are missing or unreadable."""
    if material.kind != "rehearsal":
        return []
    return [entry for entry in material.listed("tables") if isinstance(entry, dict)]
