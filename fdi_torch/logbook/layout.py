"""A Foxglove and Lichtblick layout that shows what a log has: a plot per sensor, inputs, search, events.

Every message path names a field of the schema of its topic. It quotes names with other characters than letters of
ASCII, digits and underscores, such as `"T1.leak.size"`, as the grammar of these viewers requires.

The unit of a plot, SI as in the log, stands in its title, at its axis (Foxglove), and in the legend, because Lichtblick
has no labels of axes.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import orjson

from fdi_torch.logbook.errors import LogError
from fdi_torch.logbook.reader import Run

_PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_PLAIN_TOPIC = re.compile(r"(/[A-Za-z0-9_-]+)+")
_TEST = ("_statistic", "_threshold")
_BAND = ("_low", "_high")
_COST = {
    "/estimator/de/generation": ("Search", "generation", ("best_cost", "mean_cost")),
    "/estimator/refine/iteration": ("Refinement", "iteration", ("cost",)),
}
_TABLES = ("/observer/alarm", "/diagnosis/fault", "/gap/where", "/study/summary", "/study/trial")
_TEXTS = ("/estimate/final", "/gap/verdict")
_SECONDS = {"t", "timestamp", "wall"}
_TITLES = ("foxglovePanelTitle", "lichtblickPanelTitle")  # keys of a panel's title in the two viewers
_NO_UNIT = "no unit"
MOST_PER_TAB = 4

Panel = tuple[str, dict[str, Any]]  # type of the panel, configuration
Fields = Mapping[str, Mapping[str, str]]  # topic -> field that holds a number -> unit


def foxglove_layout(run: Run) -> dict[str, Any]:
    """The layout for this log, as JSON values. Raises LogError if the log has nothing that a panel could show."""
    fields = numeric_fields(run)
    tabs = {
        "Sensors": _sensor_plots(fields),
        "Residuals": _residual_plots(fields),
        "Inputs": _input_plots(fields),
        "Search": _cost_plots(fields),
        "Events": [("Table", {"topicPath": topic}) for topic in _TABLES if topic in fields],
        "Results": [("RawMessages", {"topicPath": topic}) for topic in _TEXTS if topic in fields],
    }
    panels: dict[str, dict[str, Any]] = {}
    pages = [
        {"title": title if first == 0 else f"{title} {first // MOST_PER_TAB + 1}", "layout": _column(names)}
        for title, made in tabs.items()
        for first in range(0, len(made), MOST_PER_TAB)
        if (names := _named(panels, made[first : first + MOST_PER_TAB]))
    ]
    if not pages:
        raise LogError(f"{run.path}: expected signals, events or results, got none that a layout could show")
    panels["Tab!fdi"] = {"activeTabIdx": 0, "tabs": pages}
    layout: Any = "Tab!fdi"
    if "/log" in fields:
        (name,) = _named(panels, [("RosOut", {"searchTerms": [], "minLogLevel": 1, "topicToRender": "/log"})])
        layout = {"direction": "column", "first": "Tab!fdi", "second": name, "splitPercentage": 82}
    unused: dict[str, Any] = {"globalVariables": {}, "userNodes": {}}
    return {"configById": panels, **unused, "playbackConfig": {"speed": 10}, "layout": layout}


def numeric_fields(run: Run) -> dict[str, dict[str, str]]:
    """For each topic, its numeric fields with their units."""
    fields: dict[str, dict[str, str]] = {}
    for channel in dict.fromkeys(message.channel for message in run.messages()):
        if _PLAIN_TOPIC.fullmatch(channel.topic):
            parts, known = _properties(channel.schema_data), fields.setdefault(channel.topic, {})
            numeric = [name for name, part in parts.items() if part.get("type") in ("number", "integer")]
            known.update({name: channel.units.get(name, "") for name in numeric})
    return fields


def _properties(schema: bytes) -> dict[str, Any]:
    """The properties of a JSON schema; empty for other schemas."""
    try:
        properties = orjson.loads(schema)["properties"]
        return {name: part for name, part in properties.items() if isinstance(part, dict)}
    except (ValueError, KeyError, TypeError, AttributeError):
        return {}


def _path(topic: str, name: str) -> str:
    if not _PLAIN.fullmatch(name):
        name = '"' + re.sub(r'(["\\])', r"\\\1", name) + '"'
    return f"{topic}.{name}"


def _sensor_plots(fields: Fields) -> list[Panel]:
    """One plot per sensor of each recording: measured, and estimated where the log has it."""
    plots = []
    for topic in _topics(fields, "/plant/", "/output"):
        model = topic.replace("/plant/", "/estimate/", 1)
        for name, unit in _signals(fields[topic]):
            lines = [(_path(topic, name), "measured")]
            lines += [(_path(model, name), "estimated")] if name in fields.get(model, {}) else []
            plots.append(_plot(_title(name, topic), unit, lines))
    return plots


def _residual_plots(fields: Fields) -> list[Panel]:
    """One plot per sensor, its residual with its band, and one per test statistic of the monitor with its threshold."""
    plots = []
    for topic in _topics(fields, ("/estimate/", "/observer/"), "/residual"):
        present = fields[topic]
        for name, unit in _signals(present):
            lines = [(_path(topic, name), "residual"), *_companions(present, topic, name, _BAND)]
            plots.append(_plot(_title(f"{name}: residual", topic), unit, lines))
        for name in _tests(present):
            title = _title(f"{name}: test statistic", topic)
            plots.append(_plot(title, _NO_UNIT, _companions(present, topic, name, _TEST)))
    return plots


def _topics(fields: Fields, start: str | tuple[str, ...], end: str) -> list[str]:
    return [topic for topic in fields if topic.startswith(start) and topic.endswith(end)]


def _tests(present: Mapping[str, str]) -> list[str]:
    """The subject of a test statistic of the monitor: a sensor, or all sensors together by a detector such as cusum."""
    return [name.removesuffix(_TEST[0]) for name in present if name.endswith(_TEST[0])]


def _companions(present: Mapping[str, str], topic: str, name: str, ends: Sequence[str]) -> list[tuple[str, str]]:
    """Path and label of the fields that are called like another one with these ends."""
    return [(_path(topic, name + end), end[1:]) for end in ends if name + end in present]


def _input_plots(fields: Fields) -> list[Panel]:
    """One plot per recording and unit of its inputs."""
    plots = []
    for topic in _topics(fields, "/plant/", "/input"):
        for unit in dict.fromkeys(unit for _, unit in _signals(fields[topic])):
            lines = [(_path(topic, name), name) for name, its in _signals(fields[topic]) if its == unit]
            plots.append(_plot(_title("Inputs", topic), unit, lines))
    return plots


def _cost_plots(fields: Fields) -> list[Panel]:
    return [
        _plot(f"{title}: cost over {step}", _NO_UNIT, [(_path(topic, name), name) for name in costs], f"{topic}.{step}")
        for topic, (title, step, costs) in _COST.items()
        if {step, *costs} <= fields.get(topic, {}).keys()
    ]


def _signals(present: Mapping[str, str]) -> list[tuple[str, str]]:
    """The fields that are signals of their own, with their units."""
    companions = {name + end for name in present for end in _BAND}
    companions |= {name + end for name in _tests(present) for end in _TEST}
    return [(name, unit) for name, unit in present.items() if name not in _SECONDS and name not in companions]


def _title(name: str, topic: str) -> str:
    """The name with the recording's group."""
    parts = topic.split("/")
    return f"{name} ({parts[2]})" if len(parts) == 4 else name


def _plot(title: str, unit: str, lines: Sequence[tuple[str, str]], over: str = "") -> Panel:
    """A plot of message paths with labels, over time or over another field. unit: empty if unknown."""
    unit = _NO_UNIT if unit == "1" else unit
    end = f", {unit}" if unit else ""
    paths = [
        {"value": value, "enabled": True, "timestampMethod": "receiveTime", "label": f"{label}{end}"}
        for value, label in lines
    ]
    plot: dict[str, Any] = dict.fromkeys(_TITLES, f"{title}{end}")
    plot |= {"paths": paths, "showLegend": True, "legendDisplay": "floating", "isSynced": not over}
    plot |= {"showXAxisLabels": True, "showYAxisLabels": True, "yAxisLabel": f"{title}{end}"}
    plot |= {"xAxisLabel": over.rpartition(".")[2] or "time, s"}
    plot |= {"xAxisVal": "custom", "xAxisPath": {"value": over, "enabled": True}} if over else {"xAxisVal": "timestamp"}
    return "Plot", plot


def _named(panels: dict[str, dict[str, Any]], made: Sequence[Panel]) -> list[str]:
    """Add the panels under new names, which are returned."""
    names = []
    for kind, config in made:
        names.append(f"{kind}!p{len(panels) + 1}")
        panels[names[-1]] = config
    return names


def _column(names: Sequence[str]) -> Any:
    """Panels of equal height below each other."""
    if len(names) == 1:
        return names[0]
    share = 100.0 / len(names)
    return {"direction": "column", "first": names[0], "second": _column(names[1:]), "splitPercentage": share}
