"""Figure of free runs: readings, predictions of one or two plant files, and their errors."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from fdi_torch.recording import Recording
from fdi_torch.report.downsampling import thinned
from fdi_torch.report.html import short
from fdi_torch.report.numbers import axis, shown_unit
from fdi_torch.report.style import MARK, MODEL, SOFT, label_lines, set_title, styled


def free_run_figure(recording: Recording, columns: list[str], runs: Mapping[str, Tensor], title: str) -> Figure:
    """One column per sensor (`columns`: its output in the recording).

    runs: predicted readings (T, N) in SI by plant name, the better plant last.
    """
    count = len(columns)
    with styled():
        figure = Figure(figsize=(max(4.2 * count, 6.0), 5.2), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(2, count, sharex=True, squeeze=False, height_ratios=(2, 1))
        for i, column in enumerate(columns):
            predictions = {name: predicted[:, i] for name, predicted in runs.items()}
            _draw(axes[0, i], axes[1, i], recording, recording.output_names.index(column), predictions)
        set_title(figure, title)
    return figure


def _draw(upper: Axes, lower: Axes, recording: Recording, i: int, runs: Mapping[str, Tensor]) -> None:
    unit, scale = shown_unit(recording.output_units[i], recording.output_names[i])
    counted, outputs = recording.mask[:, i].cpu().numpy(), recording.outputs[:, i].cpu().numpy()
    read = scale * np.where(counted, outputs, np.nan)
    time = recording.time.cpu().numpy()
    upper.plot(*thinned(time, read), color=SOFT, lw=2.0, label="measured")
    lower.axhline(0.0, color=SOFT, lw=0.7)
    for (name, predicted), color in zip(runs.items(), (MARK, MODEL)[-len(runs) :], strict=True):
        model = scale * predicted.detach().cpu().numpy()
        upper.plot(*thinned(time, model), color=color, lw=1.0, label=name)
        lower.plot(*thinned(time, read - model), color=color, lw=0.8)
    upper.set_title(short(recording.output_names[i]), loc="left")
    upper.set_ylabel(axis("reading", unit))
    lower.set_ylabel(axis("residual", unit))
    lower.set_xlabel("time, s")
    label_lines(upper)
