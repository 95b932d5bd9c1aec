"""Panels that several sections share: lines, residuals, bars, confidence ellipses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from fdi_torch.report.downsampling import thinned
from fdi_torch.report.html import short
from fdi_torch.report.style import INK, MARK, MODEL, OTHER, SOFT, label_lines, logarithmic, panel

Line = tuple[str, np.ndarray, np.ndarray, str]  # name, x, y, colour


def line_panel(title: str, x_label: str, y_label: str, lines: Sequence[Line], log: bool = False) -> Figure:
    """Lines over a common axis, labelled in their colours if there are several. log: use it if all y are positive."""
    figure, axes = panel(short(title), short(x_label), short(y_label, 60))
    for name, x, y, colour in lines:
        shown_x, shown_y = thinned(np.asarray(x, dtype=float), np.asarray(y, dtype=float))
        thin = colour == SOFT and len(lines) > 1
        axes.plot(shown_x, shown_y, color=colour, lw=0.8 if thin else 1.4, label=short(name, 18))
    values = np.concatenate([np.asarray(y, dtype=float) for _, _, y, _ in lines] or [np.zeros(0)])
    if log and len(values) and np.nanmin(values) > 0 and np.nanmax(values) > 20 * np.nanmin(values):
        logarithmic(axes)
    if len(lines) > 1:
        label_lines(axes)
    return figure


def residual_panel(
    title: str,
    y_label: str,
    time: np.ndarray,
    residual: np.ndarray,
    thresholds: Sequence[np.ndarray] = (),
    events: Sequence[float] = (),
) -> Figure:
    """A residual over time (T,), with thresholds (T,) and alarm times."""
    figure, axes = panel(short(title), "time, s", short(y_label, 60), height=2.1)
    axes.axhline(0.0, color=SOFT, lw=0.7)
    axes.plot(*thinned(time, residual), color=MODEL, lw=0.8, label="residual")
    for threshold in thresholds:
        axes.plot(*thinned(time, threshold), color=MARK, lw=1.1, ls="--", label="threshold")
    for moment in list(events)[:50]:
        axes.axvline(moment, color=MARK, lw=0.9, alpha=0.8)
    return figure


def bar_panel(
    title: str,
    x_label: str,
    names: Sequence[str],
    values: Sequence[float],
    texts: Sequence[str],
    strong: Sequence[bool],
) -> Figure:
    """Horizontal bars from the top, each with its value at the end; `strong` ones are highlighted."""
    height = max(1.2, 0.75 + 0.29 * len(names))
    figure, axes = panel(short(title), short(x_label), "", height=height)
    rows = list(range(len(names)))
    lengths = np.nan_to_num(np.asarray(values, dtype=float))
    axes.barh(rows, lengths, height=0.66, color=[MARK if s else MODEL for s in strong])
    reach = max(float(lengths.max(initial=0.0)), 1e-300)
    for row, length, text in zip(rows, lengths, texts, strict=True):
        axes.text(length + 0.02 * reach, row, text, va="center", fontsize=9.0, color=INK)
    axes.set_xlim(0.0, 1.28 * reach)
    axes.set_yticks(rows, [short(name, 26) for name in names])
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    return figure


def ellipse_panel(
    names: tuple[str, str],
    units: tuple[str, str],
    centre: np.ndarray,
    covariance: np.ndarray,
    truth: tuple[float, float] | None = None,
) -> Figure:
    """50 % and 95 % confidence regions of two parameters (chi^2 with two degrees of freedom), and the true values."""
    labels = [f"{short(n, 26)}{', ' + u if u else ''}" for n, u in zip(names, units, strict=True)]
    figure, axes = panel("", labels[0], labels[1], width=3.6, height=3.0)
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0.0, 2.0 * np.pi, 121)
    circle = np.stack((np.cos(angle), np.sin(angle)))
    for share, alpha in ((0.95, 0.14), (0.5, 0.24)):
        reach = np.sqrt(-2.0 * np.log(1.0 - share) * np.maximum(values, 0.0))
        x, y = centre[:, None] + (vectors * reach) @ circle
        axes.fill(x, y, facecolor=MODEL, alpha=alpha, edgecolor="none")
        axes.plot(x, y, color=MODEL, lw=1.0)
    axes.plot(*centre, "o", color=MODEL, ms=4)
    if truth is not None:
        axes.plot(*truth, "+", color=OTHER, ms=10, mew=2.0)
    axes.locator_params(nbins=4)
    return figure
