"""A chart of signals: its description, from which the picture and the data of the interactive chart are made. Long
signals are reduced to their extremes, without visible change.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
import orjson
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fdi_torch.clock import clock_text, clock_zero
from fdi_torch.report.html import clean, short
from fdi_torch.report.style import (
    HEIGHT,
    INK,
    MARK,
    SOFT,
    VARIABLES,
    label_lines,
    logarithmic,
    panel,
    row_letters,
)

BINS = 400
MOST_LABELS = 4  # of dashed lines in a picture
LEAST_LETTERS = 12  # of a line of such a label
LABEL_SHARE = 0.12  # of the usual height, for a line of such a label
FLAT = 1.8  # height of a picture of residuals, inches


def thinned(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A signal (T,) reduced to the minimum and maximum of each of BINS segments, in order, so that spikes remain.

    A segment without finite values becomes a gap (NaN).
    """
    if len(time) <= 2 * BINS:
        return time, values
    kept = extremes(values, BINS)
    return time[kept], values[kept]


def extremes(values: np.ndarray, bins: int) -> np.ndarray:
    """Indices of the minimum and maximum of each of `bins` segments of a signal (T,), T >= bins.

    Of a segment without finite values the first sample is taken.
    """
    edges = np.linspace(0, len(values), bins + 1).astype(int)
    missing, finite = np.isnan(values), np.isfinite(values)
    low, high = np.where(missing, np.inf, values), np.where(missing, -np.inf, values)
    kept: list[int] = []
    for first, last in pairwise(edges.tolist()):
        ends = {int(low[first:last].argmin()), int(high[first:last].argmax())} if finite[first:last].any() else {0}
        kept += sorted(first + end for end in ends)
    return np.array(kept)


def corner_points(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The corners of a signal (T,) that is constant between changes."""
    if not len(time):
        return time, values
    changes = np.flatnonzero(values[1:] != values[:-1]) + 1
    corners = np.unique(np.concatenate(([0], changes, [len(time) - 1])))
    return time[corners], values[corners]


MOST_SAMPLES = 6000  # of a line; longer ones keep the extremes of half as many segments
MOST_EVENTS = 50
TIME = "time, s"  # label of a time axis
PLANNED = "next"  # name of the clock of charts that show the proposed experiment
LATE_DIGITS, ROUNDING = 1e-5, 1e-15  # differences relative to the values: beyond the fifth digit; of rounding


class Line(NamedTuple):
    """y (T,) over x (T,). steps: a value holds until the next sample. wide: broad and pale, for lines below others."""

    name: str
    x: np.ndarray
    y: np.ndarray
    colour: str
    dashed: bool = False
    steps: bool = False
    wide: bool = False


@dataclass(frozen=True)
class Chart:
    """Lines over a common axis.

    log: use a logarithmic axis if the values span more than a decade; with zeros among them it is linear below the
    median of the positive values (asinh). level: a horizontal reference line; at 0, the lines are residuals.
    events: times of vertical lines. marks: times of thin dashed lines, each with its label.
    clock: charts of one clock show the same crosshair and zoom together. from_zero:
    a linear vertical axis begins at 0. height: of the picture, inches.
    zero: date of time 0, s since 1970; None if the axis is not time or the recording has no dates. after: words behind
    the label of the axis, as in ' after 2026-11-01 08:00:00'.

    If values differ only beyond their fifth digit, and by more than rounding, the chart shows their difference from the
    lowest one, because the labels of the axis would all be the same.
    """

    title: str
    x_label: str
    y_label: str
    lines: Sequence[Line]
    log: bool = False
    level: float | None = None
    events: Sequence[float] = ()
    marks: Sequence[tuple[float, str]] = ()
    clock: str = ""
    from_zero: bool = False
    height: float = HEIGHT
    zero: float | None = field(default_factory=clock_zero)
    after: str = ""

    def __post_init__(self) -> None:
        if self.x_label != TIME or self.clock == PLANNED:
            object.__setattr__(self, "zero", None)
        elif self.zero is not None:
            object.__setattr__(self, "after", f" after {clock_text(0.0)}")
        values = self._values()
        size, span = np.abs(values).max(initial=0.0), np.ptp(values) if len(values) else 0.0
        if self.level is None and not self.from_zero and ROUNDING * size < span < LATE_DIGITS * size:
            lines = [line._replace(y=np.asarray(line.y, dtype=float) - values.min()) for line in self.lines]
            name, comma, unit = self.y_label.partition(", ")
            object.__setattr__(self, "lines", lines)
            object.__setattr__(self, "y_label", f"{name} above lowest{comma}{unit}")

    def _values(self) -> np.ndarray:
        """The finite values of all lines."""
        values = np.concatenate([np.asarray(line.y, dtype=float) for line in self.lines] or [np.zeros(0)])
        return values[np.isfinite(values)]

    @property
    def axis(self) -> str:
        """The label of the horizontal axis."""
        return f"{self.x_label}{self.after}"

    @property
    def scale(self) -> tuple[str, float]:
        """Kind of the vertical axis, "linear", "log" or "asinh", and the width of the linear part of the last."""
        values = self._values()
        if not self.log or not (values > 0).any() or values.min() < 0:
            return "linear", 0.0
        low = float(values.min() or np.median(values[values > 0]))
        if values.max() <= 20 * low:
            return "linear", 0.0
        return ("log", 0.0) if values.min() > 0 else ("asinh", low)


def draw(chart: Chart) -> Figure:
    """The picture, with its lines labelled in their colours if there are several."""
    figure, axes = panel(short(chart.title), short(chart.axis), short(chart.y_label, 60), height=chart.height)
    if chart.level is not None:
        axes.axhline(chart.level, color=SOFT, lw=0.8, ls="-" if chart.level == 0.0 else ":")
    for line in chart.lines:
        axes.plot(
            *thinned(np.asarray(line.x, dtype=float), np.asarray(line.y, dtype=float)),
            color=line.colour,
            lw=2.6 if line.wide else 0.8 if chart.level == 0.0 else 1.2,
            ls="--" if line.dashed else "-",
            alpha=0.44 if line.wide else 1.0,
            drawstyle="steps-post" if line.steps else "default",
            label=short(line.name, 18),
        )
    for moment in list(chart.events)[:MOST_EVENTS]:
        axes.axvline(moment, color=MARK, lw=0.9, alpha=0.8)
    kind, width = chart.scale
    if kind != "linear":
        logarithmic(axes, width)
    elif chart.from_zero:
        axes.set_ylim(bottom=0.0)
    _draw_marks(axes, chart)
    if len(chart.lines) > 1:
        label_lines(axes)
    return figure


def _draw_marks(axes: Axes, chart: Chart) -> None:
    """Dashed lines with their labels above the data, each on the side that has more room, in lines that fit there; many
    are drawn without labels.
    """
    marks = list(chart.marks)[:MOST_EVENTS]
    low, high = axes.get_xlim()
    lines = 0  # of labels so far
    for moment, label in marks:
        axes.axvline(moment, color=INK, lw=0.8, ls=(0, (2, 2)))
        place = (moment - low) / (high - low)
        right = place > 0.5
        if len(marks) <= MOST_LABELS:
            letters = int(max(place, 1.0 - place) * row_letters(axes))
            text = fill(short(label, 80), max(letters, LEAST_LETTERS), max_lines=3, placeholder="…")
            axes.annotate(
                text,
                xy=(moment, 0.99 - LABEL_SHARE * HEIGHT / chart.height * lines),
                xycoords=("data", "axes fraction"),
                xytext=(-4 if right else 4, 0),
                textcoords="offset points",
                ha="right" if right else "left",
                va="top",
                fontsize=9.0,
                color=INK,
            )
            lines += 1 + text.count("\n")
    _make_room(axes, min(LABEL_SHARE * HEIGHT / chart.height * lines, 0.6))


def _make_room(axes: Axes, share: float) -> None:
    """Extend the vertical axis, so that its upper share is free of lines."""
    scale = axes.yaxis.get_transform()
    low, high = scale.transform(np.array(axes.get_ylim()))
    bottom, top = scale.inverted().transform(np.array((low, high + (high - low) * share / (1.0 - share))))
    axes.set_ylim(bottom, top)


def chart_json(chart: Chart) -> str:
    """The chart as JSON for `assets/charts.js`: labels, lines and axes; samples as base64 of little-endian floats."""
    clocks: list[np.ndarray] = []
    lines = []
    for members in _of_one_clock(chart.lines):
        kept, complete = _kept(members)
        clocks.append(np.asarray(members[0].x, dtype=float)[kept])
        for line in members:
            drawn = np.asarray(line.y, dtype=float)[kept]
            about = {"name": clean(line.name), "colour": VARIABLES[line.colour], "clock": len(clocks) - 1}
            about |= {"dashed": line.dashed, "steps": line.steps, "wide": line.wide, "complete": complete}
            lines.append(about | {"y": _base64(drawn, "<f4")})
    described: dict[str, Any] = {
        "title": clean(chart.title),
        "x": clean(chart.x_label),
        "axis": clean(chart.axis),
        "zero": chart.zero,
        "y": clean(chart.y_label),
        "clocks": [_base64(clock, "<f8") for clock in clocks],
        "lines": lines,
        "scale": chart.scale,
        "level": chart.level,
        "from_zero": chart.from_zero,
        "marks": [(float(moment), clean(label)) for moment, label in list(chart.marks)[:MOST_EVENTS]],
        "events": [float(moment) for moment in list(chart.events)[:MOST_EVENTS]],
    }
    return orjson.dumps(described).decode()


def _of_one_clock(lines: Sequence[Line]) -> list[list[Line]]:
    """The lines grouped by equal x, so that these are stored once."""
    groups: list[list[Line]] = []
    for line in lines:
        same = next((g for g in groups if np.array_equal(g[0].x, line.x)), None)
        if same is None:
            groups.append([line])
        else:
            same.append(line)
    return groups


def _kept(lines: Sequence[Line]) -> tuple[np.ndarray, bool]:
    """Indices of the samples to keep for lines (T,) with equal x, and whether these are all."""
    count = len(lines[0].x)
    if count <= MOST_SAMPLES:
        return np.arange(count), True
    kept = [extremes(np.asarray(line.y, dtype=float), MOST_SAMPLES // 2) for line in lines]
    return np.unique(np.concatenate(kept)), False


def _base64(values: np.ndarray, kind: str) -> str:
    with np.errstate(over="ignore"):
        return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode()
