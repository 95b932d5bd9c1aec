"""Pictures of a noise study: correlation against signal-to-noise ratio, and each parameter's estimates at each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from fdi_torch.parameters import ParameterSpace, display_unit

SPREAD, BOUND, TRUTH = "#1d4ed8", "#c2410c", "#111827"
_REACH = 1.96


def correlation_figure(snr_db: Sequence[float], rho: Sequence[Any]) -> Figure:
    """Figure 3 of the 2020 paper as distributions. rho: for each SNR the correlations (trials, C) at the estimate."""
    figure, axes = _figure(1)
    sums = [1.0 - np.asarray(values).mean(axis=1) for values in rho]
    _boxes(axes[0], snr_db, sums)
    axes[0].set_yscale("log")
    axes[0].set_xlabel("SNR [dB]")
    axes[0].set_ylabel("1 - mean correlation of the outputs [1]")
    axes[0].set_title("correlation at the estimate")
    return figure


def error_figure(
    space: ParameterSpace, snr_db: Sequence[float], estimates: Sequence[Any], truth: Tensor, bounds: Sequence[Any]
) -> Figure:
    """Table 3 of the 2020 paper as distributions, one picture a parameter: estimates (trials, P) less truth (P,).

    bounds: for each SNR the Cramer-Rao bound (P,), drawn as the band that holds 95 % of an efficient estimator's.
    """
    figure, axes = _figure(len(space))
    for i, (p, ax) in enumerate(zip(space, axes, strict=True)):
        unit, scale = display_unit(p.unit)
        _boxes(ax, snr_db, [scale * (np.asarray(values)[:, i] - float(truth[i])) for values in estimates])
        band = [_REACH * scale * np.asarray(bound)[i] for bound in bounds]
        ax.errorbar(snr_db, np.zeros(len(band)), yerr=band, fmt="none", ecolor=BOUND, capsize=9, lw=1, label="bound")
        ax.axhline(0.0, lw=0.6, color=TRUTH)
        ax.set_yscale("symlog", linthresh=max(min(band), 1e-12))
        ax.set_title(p.name.removesuffix(".size"))
        ax.set_xlabel("SNR [dB]")
        ax.set_ylabel(f"estimate - truth [{unit or '1'}]")
    axes[0].legend(frameon=False)
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
        boxprops={"color": SPREAD},
        whiskerprops={"color": SPREAD},
        capprops={"color": SPREAD},
        medianprops={"color": TRUTH},
    )
    ax.set_xticks(list(places))
    ax.grid(alpha=0.25)
