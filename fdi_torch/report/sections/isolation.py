"""A study of fault modes: which set of faults was stated for which that was there."""

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
    """The matrix of modes as a picture, and each mode in a row of a table."""
    labels, counts = _labels(material), material.arrays.get("confusion")
    if counts is None or counts.shape != (len(labels), len(labels)) or not 0 < len(labels) <= MOST_MODES:
        return None
    found = material.about("result")
    told = [found.get(f"isolation.{name}", "?") for name in ("right", "trials", "missed", "false")]
    words = (
        "{} of {} modes stated as they are; {} faults missed, {} stated that are not there. ".format(*told)
        + "A row is the mode that is there, a column the one that is stated; the table names them."
    )
    rows = [_row(k, labels, counts) for k in range(len(labels)) if counts[k].sum()]
    listed = table(["", "mode", "trials", "right", "most often taken for"], rows)
    return Section("Isolation", [words, [Picture("isolation", matrix_panel(counts))], folded("The modes", listed)])


def matrix_panel(counts: np.ndarray) -> Figure:
    """Shares of each row (M, M), the darker the larger; right is on the diagonal."""
    figure, axes = panel("Stated against true", "mode stated", "mode that is there", height=4.0)
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
    """The names of the modes, as the result record holds them."""
    return [str(label) for label in material.listed("isolation.labels")]
