"""Sections about a study: summary by setting, errors, trials, and stated against true sets of faults."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import orjson
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from fdi_torch.amounts import parameter_words
from fdi_torch.effects import build_network, effect, full_name
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.exact_constants import exact_constants_sentence
from fdi_torch.quantities import display_unit
from fdi_torch.report.html import folded, short, shown, table
from fdi_torch.report.material import Material, Payload
from fdi_torch.report.numbers import axis, percent, shown_unit
from fdi_torch.report.section import Picture, Section
from fdi_torch.report.sections.estimate import column
from fdi_torch.report.setting_tables import LEGEND, isolation_sentence, setting_tables
from fdi_torch.report.style import MARK, MODEL, SOFT, logarithmic, panel
from fdi_torch.study.estimators import ESTIMATORS, Estimator

TRIAL, SUMMARY = "/study/trial", "/study/summary"
MOST_PANELS, MOST_GROUPS = 9, 40
SHOWN: tuple[Estimator, ...] = ("free", "boxed", "correlation", "search")
"""Estimators in the order of preference: the first one that a log has is shown."""
_OWN = ("t", "trial", "trials", "group", "seed", "status")


def summary_section(material: Material) -> Section | None:
    """The scores of each setting, as the terminal shows them."""
    settings = [(str(m.get("group", "")), m.get("trials", ""), m) for m in material.of(SUMMARY)]
    if not settings:
        return None
    keys = [key.removesuffix(".rmse") for _, _, m in settings for key in m if key.endswith(".rmse")]
    names = {key.partition(".")[2] for key in keys}
    units = {s.column: s.unit for s in material.plant.sensors} if material.plant else {}
    tables = setting_tables(settings, units | {name: _si_unit_of(material, name) for name in names})
    legend, remark = [LEGEND] if len(tables) == len(settings) else [], _exact_constants(material, names)
    return Section("Settings", [*map(shown, tables), *legend, *([remark] if remark else [])])


def _exact_constants(material: Material, estimated: set[str]) -> str:
    """Which constants with a tolerance the trials take as exact; '' if none, or if the log has no plant."""
    if material.plant is None:
        return ""
    return exact_constants_sentence(material.plant, estimated, build_network(material.plant).constants.names)


def error_section(material: Material) -> Section | None:
    """Absolute error of every trial in each parameter, with the Cramér-Rao bound."""
    trials = [m for m in material.of(TRIAL) if isinstance(m.get("truth"), list)]
    estimator = next((name for name in SHOWN if trials and name in trials[0]), None)
    if estimator is None:
        return None
    groups, pictures = _grouped(trials), []
    for i, name in enumerate(_parameters(material, estimator, len(trials[0]["truth"]))[:MOST_PANELS]):
        unit, scale = display_unit(_si_unit_of(material, name), name)
        errors, bounds = [], []
        for own in groups.values():
            errors.append(scale * np.array([abs(float(m[estimator][i]) - float(m["truth"][i])) for m in own]))
            bounds.append(scale * np.median([float(m["bound"][i]) if "bound" in m else np.nan for m in own]))
        label = axis("size of the error", unit)
        names = list(groups)
        figure = group_panel(parameter_words(name), label, names, errors, lambda e: float(np.sqrt(np.mean(e**2))))
        if all(np.nanmax(e, initial=0.0) > 0 for e in errors):
            logarithmic(figure.axes[0])
        figure.axes[0].plot(range(len(groups)), bounds, "_", color=MARK, ms=22, mew=2.0)
        pictures.append(Picture(f"errors_{i + 1}", figure))
    words = "Each point is a trial, blue their root mean square, orange its Cramér-Rao bound."
    return Section("Errors", [f"Estimator: {estimator}, {ESTIMATORS[estimator]}. {words}", pictures])


def _si_unit_of(material: Material, name: str) -> str:
    """The SI unit of a parameter, by the plant of the log; "SI" if it is not known."""
    try:
        place = ParameterName.parse(name)
        placements = [Placement(effect(place.effect), place.place)] if place.effect else []
        network = None if material.plant is None else build_network(material.plant, placements)
        return "SI" if network is None else network.constants[name].unit
    except ValueError:
        return "SI"


def _parameters(material: Material, estimator: str, count: int) -> list[str]:
    """Names from the summary's ESTIMATOR.PARAMETER.rmse, else from the configuration, else numbers."""
    keys = [k for m in material.of(SUMMARY)[:1] for k in m if k.startswith(f"{estimator}.") and k.endswith(".rmse")]
    names = [key.removeprefix(f"{estimator}.").removesuffix(".rmse") for key in keys] or _configured(material)
    return names if len(names) == count else [f"parameter {i + 1}" for i in range(count)]


def _configured(material: Material) -> list[str]:
    """The parameters that the configuration in the log asks for; none if it cannot be read."""
    try:
        asked = orjson.loads(material.about("config").get("estimate.parameters", "[]"))
        names = [str(each["name"]) for each in asked]
        return [full_name(name, material.plant) for name in names] if material.plant else names
    except (ValueError, TypeError, KeyError):
        return []


def trials_section(material: Material) -> Section | None:
    """Shares of the trials' statuses, and each number of the trials by setting, with its median."""
    trials = material.of(TRIAL)
    if not trials or material.kind in ("challenge", "rehearsal"):  # they have tables of their own
        return None
    groups = _grouped(trials)
    statuses = list(dict.fromkeys(str(m.get("status", "")) for m in trials))[:6]
    rows = []
    for group, own in groups.items():
        ends = [sum(str(m.get("status", "")) == status for m in own) / len(own) for status in statuses]
        rows.append([group, str(len(own)), *(percent(share) for share in ends)])
    names = dict.fromkeys(k for m in trials for k, v in m.items() if k not in _OWN and isinstance(v, float))
    varying = [name for name in names if len({m[name] for m in trials if name in m}) > 1]
    pictures = []
    for k, name in enumerate(varying[:MOST_PANELS]):
        unit, scale = shown_unit(material.unit(TRIAL, name))
        values = [scale * column(own, name) for own in groups.values()]
        figure = group_panel(name, axis(name, unit), list(groups), values)
        pictures.append(Picture(f"trials_{k + 1}", figure))
    ended = table(["setting", "trials", *(status or "ended" for status in statuses)], rows)
    blocks: list[Any] = [folded("How the trials ended", ended)]
    blocks += ["Each point is a trial, blue their median.", pictures] if pictures else []
    blocks += ["The cost is the negative logarithm of the likelihood."] if "cost" in varying else []
    return Section("Trials", blocks)


def group_panel(
    title: str,
    label: str,
    groups: Sequence[str],
    values: Sequence[np.ndarray],
    bar: Callable[[np.ndarray], float] = lambda points: float(np.median(points)),
) -> Figure:
    """Points of every group side by side, with horizontal jitter, and a bar at their median or another statistic."""
    figure, axes = panel(short(title), "", short(label))
    for k, points in enumerate(values):
        points = points[np.isfinite(points)]
        height, points = bar(points) if len(points) else np.nan, points[:2000]
        jitter = 0.3 * (np.modf(np.arange(len(points)) * 0.6180339887)[0] - 0.5)
        axes.plot(k + jitter, points, ".", color=SOFT, ms=2.5, alpha=0.7)
        axes.plot([k - 0.25, k + 0.25], [height] * 2, color=MODEL, lw=2.0)
    turned = max((len(g) for g in groups), default=0) * len(groups) > 36
    axes.set_xticks(
        range(len(groups)),
        [short(g, 18) for g in groups],
        rotation=45 if turned else 0,
        ha="right" if turned else "center",
    )
    return figure


def _grouped(trials: Sequence[Payload]) -> dict[str, list[Payload]]:
    """The trials of each setting."""
    groups: dict[str, list[Payload]] = {}
    for trial in trials:
        groups.setdefault(str(trial.get("group", "")), []).append(trial)
    return dict(list(groups.items())[:MOST_GROUPS])


MOST_MODES = 64
MOST_NAMED, LONGEST_MODE = 12, 24


def isolation_section(material: Material) -> Section | None:
    """The confusion matrix of the modes as a picture, and a table with one row per mode."""
    labels, counts = [*map(str, material.listed("isolation.labels"))], material.arrays.get("confusion")
    if counts is None or counts.shape != (len(labels), len(labels)) or not 0 < len(labels) <= MOST_MODES:
        return None
    result = material.about("result")
    sentence = isolation_sentence({name.removeprefix("isolation."): text for name, text in result.items()})
    words = f"{sentence} Row: true mode; column: stated mode; the table has their full names."
    rows = [_row(k, labels, counts) for k in range(len(labels)) if counts[k].sum()]
    listed = table(["", "mode", "trials", "right", "most often taken for"], rows)
    picture = Picture("isolation", matrix_panel(counts, labels))
    return Section("Isolation", [words, [picture], folded("The modes", listed)])


def matrix_panel(counts: np.ndarray, labels: Sequence[str]) -> Figure:
    """Share of each row (M, M) as a heat map; right answers are on the diagonal. labels: names of the modes, written
    beside the rows if these are at most `MOST_NAMED`.
    """
    named = len(labels) <= MOST_NAMED
    rows, height = ("", 2.9) if named else ("true mode", 4.0)  # the names leave no room for a label beside them
    figure, axes = panel("Stated against true", "stated mode", rows, height=height)
    share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    for i, j in np.argwhere(share > 0):
        strength = 0.15 + 0.85 * float(share[i, j])
        axes.add_patch(Rectangle((j + 0.5, i + 0.5), 1, 1, facecolor=MODEL, alpha=strength, edgecolor="none"))
    axes.set_xlim(0.5, len(counts) + 0.5)
    axes.set_ylim(len(counts) + 0.5, 0.5)
    axes.set_aspect("equal")
    axes.grid(False)
    for side in (axes.xaxis, axes.yaxis):
        side.set_major_locator(MaxNLocator(8, integer=True, min_n_ticks=1))
    if named:
        names = [f"{short(label, LONGEST_MODE)}  {number}" for number, label in enumerate(labels, 1)]
        axes.set_yticks(range(1, len(labels) + 1), names)
    return figure


def _row(k: int, labels: list[str], counts: np.ndarray) -> list[str]:
    wrong = np.where(np.arange(len(labels)) == k, 0, counts[k])
    worst = int(wrong.argmax())
    taken = f"{short(labels[worst], 60)} ({percent(wrong[worst] / counts[k].sum())})" if wrong[worst] else ""
    return [str(k + 1), short(labels[k], 60), str(int(counts[k].sum())), percent(counts[k, k] / counts[k].sum()), taken]
