"""The figures of the 2020 paper, drawn from arrays."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fdi_torch.report.chart import thinned
from fdi_torch.report.style import FAINT, INK, MARK, MODEL, OTHER, SOFT, label_lines, panel, styled

_FIVE = (MODEL, MARK, OTHER, INK, SOFT)


def correlation_figure(snr: np.ndarray, sums: np.ndarray, law_snr: np.ndarray, law: np.ndarray) -> Figure:
    """Figure 3: the sum of correlations at the estimate over SNR (dB), and its expected value under noise."""
    figure, axes = panel("Correlation against noise", "SNR, dB", "sum of correlations", 6.0, 3.2)
    axes.plot(law_snr, law, color=SOFT, label="3 / √(1 + 10^(−SNR/10))")
    axes.plot(snr, sums, "o", color=MODEL, label="at the estimate")
    label_lines(axes)
    return figure


def convergence_figure(
    history: np.ndarray, refined: np.ndarray, truth: np.ndarray, names: Sequence[str], title: str
) -> Figure:
    """Figures 4 and 5: the best member (G, P) after each generation, refined and true values (P,)."""
    figure, axes = panel(title, "generation", "parameter", 7.0, 3.6)
    generation = np.arange(1, len(history) + 1)
    for i, name in enumerate(names):
        colour = _FIVE[i % len(_FIVE)]
        axes.axhline(truth[i], color=colour, lw=0.7, ls=(0, (4, 3)))
        axes.plot(generation, history[:, i], color=colour, lw=1.2, label=name)
        axes.plot(generation[-1] * 1.03, refined[i], "D", color=colour, ms=4)
    axes.set_xlim(0.0, 1.07 * len(history))
    label_lines(axes, columns=len(names))
    return figure


def outputs_figure(time: np.ndarray, read: np.ndarray, estimate: np.ndarray, changes: Sequence[float]) -> Figure:
    """Figure 6: readings and estimated outputs (S, C) in cm, one panel per output. changes: onset times, s."""
    figure, panels = _stack(read.shape[1], "Outputs and their estimate")
    for i, axes in enumerate(panels):
        _mark(axes, changes)
        axes.plot(*thinned(time, read[:, i]), color=SOFT, lw=2.4, label="measured")
        axes.plot(*thinned(time, estimate[:, i]), color=MODEL, lw=1.0, label="estimate")
        axes.set_ylabel(f"h{i + 1}, cm")
    label_lines(panels[0])
    return figure


def residuals_figure(
    time: np.ndarray,
    nominal: np.ndarray,
    adaptive: np.ndarray,
    fitted: np.ndarray,
    changes: Sequence[float],
    alarms: Sequence[float],
) -> Figure:
    """Figure 7: residuals (S, C) in cm of the observer with nominal parameters, of the adaptive observer, and of the
    model fitted to each window.
    """
    figure, panels = _stack(nominal.shape[1], "Residuals of the observers")
    for i, axes in enumerate(panels):
        _mark(axes, changes)
        for k, alarm in enumerate(alarms):
            axes.axvline(alarm, color=MARK, lw=1.0, label=None if i or k else "alarm")
        axes.plot(*thinned(time, nominal[:, i]), color=SOFT, lw=2.4, label="nominal parameters")
        axes.plot(*thinned(time, adaptive[:, i]), color=MODEL, lw=1.0, label="newest parameters")
        axes.plot(*thinned(time, fitted[:, i]), color=OTHER, lw=1.0, label="fit of the window")
        axes.set_ylabel(f"r{i + 1}, cm")
    label_lines(panels[0])
    return figure


def confusion_figure(counts: np.ndarray, rows: Sequence[str], columns: Sequence[str]) -> Figure:
    """Share of each row's draws (M, M + 1) as a heat map: simulated against stated modes."""
    figure, axes = panel("Fault modes: simulated against stated", "stated", "simulated", 8.0, 7.4)
    with styled():
        share = counts / counts.sum(axis=1, keepdims=True)
        shown = axes.imshow(
            np.where(share > 0, share, np.nan), cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto", zorder=2.0
        )
        axes.set_xticks(range(len(columns)), columns, rotation=90, fontsize=7)
        axes.set_yticks(range(len(rows)), rows, fontsize=7)
        axes.grid(color=FAINT, lw=0.3, zorder=1.0)
        axes.set_axisbelow(True)
        figure.colorbar(shown, ax=axes, shrink=0.5, label="share of the draws")
    return figure


def _stack(count: int, title: str) -> tuple[Figure, list[Axes]]:
    """Panels above each other with a common time axis."""
    with styled():
        figure = Figure(figsize=(7.5, 1.7 * count + 0.6), layout="constrained")
        FigureCanvasAgg(figure)
        grid = figure.subplots(count, 1, sharex=True, squeeze=False)
        figure.suptitle(title, x=0.01, ha="left", fontweight="bold", fontsize=10.5)
        grid[-1, 0].set_xlabel("time, s")
    return figure, list(grid[:, 0])


def _mark(axes: Axes, changes: Sequence[float]) -> None:
    for change in changes:
        axes.axvline(change, color=OTHER, lw=0.8, ls=(0, (4, 3)))
