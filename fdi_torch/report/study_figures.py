"""Figures of a noise study: correlation over SNR, and the distribution of each parameter's error."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from fdi_torch.parameters import ParameterSpace
from fdi_torch.report.style import INK, MARK, MODEL, logarithmic

_REACH = 1.96


def correlation_figure(snr_db: Sequence[float], rho: Sequence[Any]) -> Figure:
    """Figure 3 of the 2020 paper as distributions. rho: for each SNR the correlations (trials, C) at the estimate."""
    figure, axes = _figure(1)
    sums = [1.0 - np.asarray(values).mean(axis=1) for values in rho]
    _boxes(axes[0], snr_db, sums)
    logarithmic(axes[0])
    axes[0].set_xlabel("SNR [dB]")
    axes[0].set_ylabel("1 - mean correlation of the outputs [1]")
    axes[0].set_title("correlation at the estimate")
    return figure


def error_figure(
    space: ParameterSpace, snr_db: Sequence[float], estimates: Sequence[Any], truth: Tensor, bounds: Sequence[Any]
) -> Figure:
    """Table 3 of the 2020 paper as distributions, one picture a parameter: estimates (trials, P) less truth (P,).

    In units of the Cramer-Rao bound (P,) of each SNR: an efficient estimator keeps 95 % between the lines.
    """
    figure, axes = _figure(len(space))
    for i, (p, ax) in enumerate(zip(space, axes, strict=True)):
        errors = [np.asarray(values)[:, i] - float(truth[i]) for values in estimates]
        _boxes(ax, snr_db, [e / np.asarray(bound)[i] for e, bound in zip(errors, bounds, strict=True)])
        for line in (-_REACH, 0.0, _REACH):
            ax.axhline(line, lw=0.8, color=MARK if line else INK)
        ax.set_title(p.name.removesuffix(".size"))
        ax.set_xlabel("SNR [dB]")
    axes[0].set_ylabel("(estimate - truth) / bound [1]")
    return figure


def _figure(count: int) -> tuple[Figure, list[Any]]:
    figure = Figure(figsize=(max(3.4 * count, 5.5), 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, list(figure.subplots(1, count, squeeze=False)[0])


def _boxes(ax: Any, places: Sequence[float], values: Sequence[Any]) -> None:
    """Quartiles as a box, 2.5 % and 97.5 % as whiskers, at each place."""
    width = 0.4 * (min(np.diff(sorted(set(places)))) if len(set(places)) > 1 else 10.0)
    ax.boxplot(
        values,
        positions=list(places),
        widths=width,
        whis=(2.5, 97.5),
        showfliers=False,
        manage_ticks=False,
        boxprops={"color": MODEL},
        whiskerprops={"color": MODEL},
        capprops={"color": MODEL},
        medianprops={"color": INK},
    )
    ax.set_xticks(list(places))
    ax.grid(alpha=0.25)
