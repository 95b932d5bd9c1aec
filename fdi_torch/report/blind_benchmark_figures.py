"""Figures of a blind benchmark: shares of right answers with intervals, confusion matrix, calibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from fdi_torch.report.html import short
from fdi_torch.report.style import INK, MARK, MODEL, OTHER, PAPER, SOFT, label_lines, panel

Share = Mapping[str, Any]
"""share, of, ci95."""


def shares_panel(
    title: str, kinds: Sequence[str], own: Sequence[Share], others: Mapping[str, Sequence[Share]]
) -> Figure:
    """Share of right answers of each kind with its interval, and small marks for the baselines."""
    figure, axes = panel(short(title), "right answers, %", "", height=1.1 + 0.3 * len(kinds))
    rows = np.arange(len(kinds))
    for (name, shares), colour, mark in zip(others.items(), (OTHER, SOFT, INK, MARK), "dx+^", strict=False):
        x = [_share(s) if s else np.nan for s in shares]
        axes.plot(100 * np.array(x), rows, mark, color=colour, ms=5, label=short(name, 20).replace("_", " "))
    low, middle, high = (100 * np.array([pick(s) for s in own]) for pick in (_low, _share, _high))
    axes.hlines(rows, low, high, color=MODEL, lw=2.0, alpha=0.5)
    axes.plot(middle, rows, "o", color=MODEL, ms=6, label="fdi")
    axes.set_xlim(-3, 103)
    axes.set_yticks(rows, [f"{short(k, 16)} ({s['of']})" for k, s in zip(kinds, own, strict=True)])
    axes.invert_yaxis()
    label_lines(axes, columns=2)
    return figure


def confusion_panel(title: str, rows: Sequence[str], columns: Sequence[str], counts: np.ndarray) -> Figure:
    """Counts (rows, columns) of the true cause against the answer; right answers are blue."""
    figure, axes = panel(short(title), "", "", height=1.35 + 0.27 * len(rows))
    for i, j in np.argwhere(counts > 0):
        right = rows[i] == columns[j] or columns[j] == "unknown, there"
        axes.add_patch(Rectangle((j - 0.5, i - 0.5), 1, 1, facecolor=MODEL if right else MARK, edgecolor=PAPER))
        axes.text(j, i, str(int(counts[i, j])), ha="center", va="center", fontsize=9.0, color=PAPER)
    axes.set_xlim(-0.5, len(columns) - 0.5)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_yticks(range(len(rows)), [short(name, 22) for name in rows])
    axes.set_xticks(range(len(columns)), [short(name, 22) for name in columns], rotation=45, ha="right")
    axes.tick_params(length=0)
    return figure


def calibration_panel(title: str, bins: Sequence[Mapping[str, Any]]) -> Figure:
    """Frequency with which the best explanation was true, against its stated probability (orange mark)."""
    figure, axes = panel(short(title), "stated probability of the best explanation", "it was true, %")
    at = np.arange(len(bins))
    low, middle, high = (100 * np.array([pick(b) for b in bins]) for pick in (_low, _share, _high))
    axes.vlines(at, low, high, color=MODEL, lw=2.0, alpha=0.5)
    axes.plot(at, middle, "o", color=MODEL, ms=6)
    axes.plot(at, [100 * b["stated"] for b in bins], "_", color=MARK, ms=22, mew=2.0)
    axes.set_xticks(at, [f"{b['low']:g}–{b['high']:g}\n({b['of']})" for b in bins])
    axes.set_xlim(-0.6, len(bins) - 0.4)
    axes.set_ylim(-3, 103)
    return figure


def _low(score: Share) -> float:
    return float(score["ci95"][0])


def _share(score: Share) -> float:
    return float(score["share"])


def _high(score: Share) -> float:
    return float(score["ci95"][1])
