"""Figure of readings beside the predictions of one or two models, with the residuals of each sensor and the inputs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import cycle
from textwrap import fill

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec

from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording
from fdi_torch.report.chart import corner_points, thinned
from fdi_torch.report.html import short, typeset
from fdi_torch.report.numbers import axis, shown_unit
from fdi_torch.report.style import INK, MARK, MODEL, OTHER, SOFT, label_lines, set_panel_title, set_title, styled

ABREAST, MOST_INPUTS = 4, 12
LABEL_LETTERS = 14  # of a line of the label of a low panel
INPUTS_HEIGHT = 1.5  # of the panels of the inputs, inches


def fit_figure(
    recording: Recording,
    predictions: Mapping[str, torch.Tensor],
    title: str,
    plant: PlantDescription,
    columns: Sequence[str] | None = None,
) -> Figure:
    """Readings and predictions of each sensor above its residuals, and below all sensors the inputs; at most `ABREAST`
    sensors stand side by side.

    predictions: readings (T, N) in SI by the name of the model, the better one last. columns (N,): the outputs of the
    recording that are predicted; by default all. plant: names the sensors.
    """
    columns = recording.output_names if columns is None else columns
    rows = math.ceil(len(columns) / ABREAST)
    abreast = math.ceil(len(columns) / rows)
    inputs = [i for i, channel in enumerate(recording.input_names) if channel in plant.channels()][:MOST_INPUTS]
    last, ratios = (INPUTS_HEIGHT, (0.9,)) if inputs else (0.0, ())
    with styled():
        figure = Figure(figsize=(max(4.2 * abreast, 6.0), 5.2 * rows + last), layout="constrained")
        FigureCanvasAgg(figure)
        heights = (2, 1) * rows + ratios
        grid = figure.add_gridspec(len(heights), abreast, height_ratios=heights)
        axes = grid.subplots(sharex=True, squeeze=False)
        pairs = [(axes[2 * row, k], axes[2 * row + 1, k]) for row in range(rows) for k in range(abreast)]
        for i, (column, (upper, lower)) in enumerate(zip(columns, pairs, strict=False)):
            set_panel_title(upper, short(plant.channel_words(column)))
            of_sensor = {name: predicted[:, i] for name, predicted in predictions.items()}
            _draw_sensor(upper, lower, recording, recording.output_names.index(column), of_sensor)
        for unused in (axis for pair in pairs[len(columns) :] for axis in pair):
            unused.remove()
        if inputs:
            for unused in axes[-1]:
                unused.remove()
            _draw_inputs(figure, grid[-1, :], recording, inputs)
        set_title(figure, typeset(title))
    return figure


def _draw_inputs(figure: Figure, place: SubplotSpec, recording: Recording, inputs: Sequence[int]) -> None:
    """The inputs with these numbers, those of one unit together."""
    shown = {i: shown_unit(recording.input_units[i], recording.input_names[i]) for i in inputs}
    units = dict.fromkeys(unit for unit, _ in shown.values())
    places = place.subgridspec(1, len(units))
    time = recording.time.cpu().numpy()
    for k, unit in enumerate(units):
        panel = figure.add_subplot(places[0, k])
        own = [i for i in inputs if shown[i][0] == unit]
        for i, colour in zip(own, cycle((MODEL, MARK, OTHER, INK, SOFT))):
            values = shown[i][1] * recording.inputs[:, i].cpu().numpy()
            held = recording.hold == "zero_order"
            at, values = corner_points(time, values) if held else thinned(time, values)
            drawn = "steps-post" if held else "default"
            panel.plot(at, values, color=colour, lw=1.0, drawstyle=drawn, label=short(recording.input_names[i], 18))
        name = short(recording.input_names[own[0]], 18) if len(own) == 1 else "input"
        panel.set_ylabel(fill(axis(name, unit), LABEL_LETTERS))
        panel.set_xlabel("time, s")
        if len(own) > 1:
            label_lines(panel)


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
    lower.set_ylabel(fill(axis("measured − model", unit), LABEL_LETTERS))
    lower.set_xlabel("time, s")
    lower.tick_params(labelbottom=True)
    label_lines(upper)
