"""Section about a study of fault modes: stated against true sets of faults."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from fdi_torch.report.html import folded, short, table
from fdi_torch.report.material import Material
from fdi_torch.report.numbers import percent
from fdi_torch.report.section import Picture, Section
from fdi_torch.report.style import MODEL, panel

MOST_MODES = 64


def isolation_section(material: Material) -> Section | None:
    """The confusion matrix of the modes as a picture, and a table with one row per mode."""
    labels, counts = _labels(material), material.arrays.get("confusion")
    if counts is None or counts.shape != (len(labels), len(labels)) or not 0 < len(labels) <= MOST_MODES:
        return None
    result = material.about("result")
    counts_ = [result.get(f"isolation.{name}", "?") for name in ("right", "trials", "missed", "false")]
    words = (
        "{} of {} modes stated correctly; {} faults missed, {} false faults. ".format(*counts_)
        + "Row: true mode; column: stated mode; the table has their names."
    )
    rows = [_row(k, labels, counts) for k in range(len(labels)) if counts[k].sum()]
    listed = table(["", "mode", "trials", "right", "most often taken for"], rows)
    return Section("Isolation", [words, [Picture("isolation", matrix_panel(counts))], folded("The modes", listed)])


def matrix_panel(counts: np.ndarray) -> Figure:
    """Share of each row (M, M) as a heat map; right answers are on the diagonal."""
    figure, axes = panel("Stated against true", "stated mode", "true mode", height=4.0)
    share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    for row, column in np.argwhere(share > 0):
        strength = 0.15 + 0.85 * float(share[row, column])
        axes.add_patch(Rectangle((column + 0.5, row + 0.5), 1, 1, facecolor=MODEL, alpha=strength, edgecolor="none"))
    axes.set_xlim(0.5, len(counts) + 0.5)
    axes.set_ylim(len(counts) + 0.5, 0.5)
    axes.set_aspect("equal")
    axes.grid(False)
    for side in (axes.xaxis, axes.yaxis):
        side.set_major_locator(MaxNLocator(8, integer=True, min_n_ticks=1))
    return figure


def _row(k: int, labels: list[str], counts: np.ndarray) -> list[str]:
    wrong = np.where(np.arange(len(labels)) == k, 0, counts[k])
    worst = int(wrong.argmax())
    taken = f"{short(labels[worst], 60)} ({percent(wrong[worst] / counts[k].sum())})" if wrong[worst] else ""
    return [str(k + 1), short(labels[k], 60), str(int(counts[k].sum())), percent(counts[k, k] / counts[k].sum()), taken]


def _labels(material: Material) -> list[str]:
    """Names of the modes from the result record."""
    return [str(label) for label in material.listed("isolation.labels")]
