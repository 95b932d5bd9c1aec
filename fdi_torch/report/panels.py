"""Panels that several sections share: bars and confidence ellipses."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill

import numpy as np
from matplotlib.figure import Figure

from fdi_torch.report.html import short
from fdi_torch.report.style import INK, MARK, MODEL, OTHER, panel

BAR_NAME = 28  # letters of a line of a bar's name, which has at most two
ONE_LINE = 26  # letters of a parameter's name beside an axis


def bar_panel(
    title: str,
    x_label: str,
    names: Sequence[str],
    values: Sequence[float],
    texts: Sequence[str],
    strong: Sequence[bool],
) -> Figure:
    """Horizontal bars from the top, each with its value at the end; `strong` ones are highlighted."""
    labels = [fill(short(name, 80), BAR_NAME, max_lines=2, placeholder="…") for name in names]
    height = 0.6 + (0.4 if any("\n" in label for label in labels) else 0.29) * len(names)
    figure, axes = panel(short(title), short(x_label), "", height=height)
    rows = list(range(len(names)))
    lengths = np.nan_to_num(np.asarray(values, dtype=float))
    axes.barh(rows, lengths, height=0.66, color=[MARK if s else MODEL for s in strong])
    reach = max(float(lengths.max(initial=0.0)), 1e-300)
    for row, length, text in zip(rows, lengths, texts, strict=True):
        axes.text(length + 0.02 * reach, row, text, va="center", fontsize=9.0, color=INK)
    axes.set_xlim(0.0, 1.28 * reach)
    axes.set_yticks(rows, labels)
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    return figure


def _in_two_lines(name: str) -> str:
    """A long name of a parameter with its place on a line of its own."""
    place, _, rest = name.partition(".")
    return short(name, ONE_LINE) if len(name) <= ONE_LINE else f"{short(place, ONE_LINE)}.\n{short(rest, ONE_LINE)}"


def ellipse_panel(
    names: tuple[str, str],
    units: tuple[str, str],
    centre: np.ndarray,
    covariance: np.ndarray,
    truth: tuple[float, float] | None = None,
) -> Figure:
    """50 % and 95 % confidence regions of two parameters (chi^2 with two degrees of freedom), and the true values."""
    labels = [f"{_in_two_lines(n)}{', ' + u if u else ''}" for n, u in zip(names, units, strict=True)]
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
