"""Figure of a fit: readings, prediction and residual of each sensor."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from fdi_torch.recording import Recording
from fdi_torch.report.downsampling import thinned
from fdi_torch.report.html import short
from fdi_torch.report.numbers import axis, shown_unit
from fdi_torch.report.style import MODEL, SOFT, label_lines, save, set_title, styled

__all__ = ["fit_figure", "save"]


def fit_figure(recording: Recording, predicted: Tensor, title: str) -> Figure:
    """Readings and prediction above, residual below, one column per sensor. predicted (T, N) in SI."""
    count = len(recording.output_names)
    with styled():
        figure = Figure(figsize=(max(4.2 * count, 6.0), 5.2), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(2, count, sharex=True, squeeze=False, height_ratios=(2, 1))
        for i in range(count):
            _draw_sensor(axes[0, i], axes[1, i], recording, predicted, i)
        set_title(figure, title)
    return figure


def _draw_sensor(upper: Axes, lower: Axes, recording: Recording, predicted: Tensor, i: int) -> None:
    unit, scale = shown_unit(recording.output_units[i], recording.output_names[i])
    counted, outputs = recording.mask[:, i].cpu().numpy(), recording.outputs[:, i].cpu().numpy()
    read = scale * np.where(counted, outputs, np.nan)
    model = scale * predicted[:, i].detach().cpu().numpy()
    time = recording.time.cpu().numpy()
    upper.plot(*thinned(time, read), color=SOFT, lw=2.4, label="measured")
    upper.plot(*thinned(time, model), color=MODEL, lw=1.0, label="estimate")
    lower.axhline(0.0, color=SOFT, lw=0.7)
    lower.plot(*thinned(time, read - model), color=MODEL, lw=0.7)
    upper.set_title(short(recording.output_names[i]))
    upper.set_ylabel(axis("reading", unit))
    lower.set_ylabel(axis("residual", unit))
    lower.set_xlabel("time, s")
    label_lines(upper)
