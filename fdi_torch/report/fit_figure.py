"""Figure of readings beside the predictions of one or two models, with the residuals of each sensor."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording
from fdi_torch.report.chart import thinned
from fdi_torch.report.html import short, typeset
from fdi_torch.report.numbers import axis, shown_unit
from fdi_torch.report.style import MARK, MODEL, SOFT, label_lines, set_panel_title, set_title, styled

ABREAST = 4


def fit_figure(
    recording: Recording,
    predictions: Mapping[str, torch.Tensor],
    title: str,
    plant: PlantDescription,
    columns: Sequence[str] | None = None,
) -> Figure:
    """Readings and predictions of each sensor above its residuals; at most `ABREAST` sensors stand side by side.

    predictions: readings (T, N) in SI by the name of the model, the better one last. columns (N,): the outputs of the
    recording that are predicted; by default all. plant: names the sensors.
    """
    columns = recording.output_names if columns is None else columns
    rows = math.ceil(len(columns) / ABREAST)
    abreast = math.ceil(len(columns) / rows)
    with styled():
        figure = Figure(figsize=(max(4.2 * abreast, 6.0), 5.2 * rows), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(2 * rows, abreast, sharex=True, squeeze=False, height_ratios=(2, 1) * rows)
        pairs = [(axes[2 * row, k], axes[2 * row + 1, k]) for row in range(rows) for k in range(abreast)]
        for i, (column, (upper, lower)) in enumerate(zip(columns, pairs, strict=False)):
            set_panel_title(upper, short(plant.channel_words(column)))
            of_sensor = {name: predicted[:, i] for name, predicted in predictions.items()}
            _draw_sensor(upper, lower, recording, recording.output_names.index(column), of_sensor)
        for unused in (axis for pair in pairs[len(columns) :] for axis in pair):
            unused.remove()
        set_title(figure, typeset(title))
    return figure


def _draw_sensor(
    upper: Axes, lower: Axes, recording: Recording, i: int, predictions: Mapping[str, torch.Tensor]
) -> None:
    unit, scale = shown_unit(recording.output_units[i], recording.output_names[i])
    counted, outputs = recording.mask[:, i].cpu().numpy(), recording.outputs[:, i].cpu().numpy()
    read = scale * np.where(counted, outputs, np.nan)
    time = recording.time.cpu().numpy()
    upper.plot(*thinned(time, read), color=SOFT, lw=2.4, label="measured")
    lower.axhline(0.0, color=SOFT, lw=0.7)
    for (name, predicted), colour in zip(predictions.items(), (MARK, MODEL)[-len(predictions) :], strict=True):
        model = scale * predicted.detach().cpu().numpy()
        upper.plot(*thinned(time, model), color=colour, lw=1.0, label=name)
        lower.plot(*thinned(time, read - model), color=colour, lw=0.7)
    upper.set_ylabel(axis("reading", unit))
    lower.set_ylabel(axis("residual", unit))
    lower.set_xlabel("time, s")
    lower.tick_params(labelbottom=True)
    label_lines(upper)
