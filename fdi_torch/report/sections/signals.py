"""Sections about the signals: inputs, readings, predictions and residuals; and the residuals before and after the
causes of a gap were added, on the hold-outs and by time, level, input and flow.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch

from fdi_torch.logbook import Signals
from fdi_torch.quantities import display_unit, quantity_text
from fdi_torch.report.chart import FLAT, Chart, Line, corner_points
from fdi_torch.report.gap_tables import model_names
from fdi_torch.report.html import Markup, shown, tag
from fdi_torch.report.material import Material
from fdi_torch.report.numbers import as_float, axis, shown_unit
from fdi_torch.report.predictions import holdout_prefix, predicted
from fdi_torch.report.section import Column, Picture, Section, channel_signals, signals
from fdi_torch.report.sections.monitor import adoptions
from fdi_torch.report.style import MODEL, OTHER, SOFT
from fdi_torch.sample_noise import sample_noise
from fdi_torch.tables import Table


def fit_section(material: Material) -> Section | None:
    """Readings, predictions and residuals of each sensor; readings only if the log has no predictions."""
    blocks: list[str | list[Column]] = []
    fitted = False
    for k, (recording, group) in enumerate(zip(material.recordings, material.groups, strict=True)):
        model, suffix = predicted(material, k), _suffix(material, k)
        fitted |= model is not None
        blocks += [tag("h4", recording_name(group))] if suffix else []
        sensors = [material.channel_words(name) for name in recording.output_names]
        followed = None if model is not None else _followed(material, recording)
        marks = [] if followed is None else adoptions(material)
        blocks += [FOLLOWED] if followed is not None else []
        blocks.append(_output_panels(recording, sensors, (model, followed), suffix, clock_of(group), marks))
        if model is not None:
            blocks += [_misfit_table(recording, sensors, model)]
    if not blocks:
        return None
    return Section("Readings against the estimate" if fitted else "Readings", blocks)


FOLLOWED = "Predicted: by the monitor's observer, with the faults that its model contains at that time."


def _followed(material: Material, recording: Signals) -> np.ndarray | None:
    """Readings (T, N) that a monitor predicted, NaN where it predicted none; None without a monitor."""
    time = material.residuals.get("t", np.zeros(0))
    if material.kind != "monitor" or not len(time):
        return None
    place = np.searchsorted(time, recording.time).clip(max=len(time) - 1)
    same = time[place] == recording.time
    none = np.full(len(time), np.nan)
    residual = np.stack([material.residuals.get(name, none)[place] for name in recording.output_names], -1)
    return np.where(same[:, None], recording.outputs - residual, np.nan)


def inputs_section(material: Material) -> Section | None:
    """Inputs: panels for those that vary, text for constant ones."""
    blocks: list[str | list[Picture]] = []
    for k, (recording, group) in enumerate(zip(material.recordings, material.groups, strict=True)):
        suffix, pictures, constant = _suffix(material, k), [], []
        for i, name in enumerate(map(material.channel_words, recording.input_names)):
            unit, channel, values = recording.input_units[i], recording.input_names[i], recording.inputs[:, i]
            if np.isfinite(values).any() and np.nanmin(values) == np.nanmax(values):
                constant.append(f"{name} at {quantity_text(float(np.nanmax(values)), unit, name=channel)}")
                continue
            held = recording.hold == "zero_order"
            time, corners = corner_points(recording.time, values) if held else (recording.time, values)
            line = Line("command", time, corners, MODEL, steps=held)
            words = f"input{suffix}_{i + 1}", f"{name}, {recording_name(group).lower()}" if suffix else name, "command"
            pictures.append(channel_signals(*words, unit, [line], channel, clock=clock_of(group)))
        of = f"{recording_name(group)}, constant" if suffix else "Constant"
        blocks += [f"{of}: {', '.join(constant)}."] if constant else []
        blocks += [pictures] if pictures else []
    return Section("Inputs", blocks) if blocks else None


def _suffix(material: Material, k: int) -> str:
    """What the names of the pictures of recording k end with; empty if there is only one."""
    return f"_{k + 1}" if len(material.recordings) > 1 else ""


def recording_name(group: str) -> str:
    """'Diagnosed recording', 'Hold-out 2': a recording of a log with several."""
    words = group.replace("_", " ").replace("holdout", "hold-out") or "diagnosed recording"
    return words[:1].upper() + words[1:]


def clock_of(group: str) -> str:
    """Name of the clock of a recording's charts."""
    return f"recording {group}"


def _output_panels(
    recording: Signals,
    sensors: Sequence[str],
    models: tuple[np.ndarray | None, np.ndarray | None],
    suffix: str,
    clock: str,
    marks: Sequence[tuple[float, str]],
) -> list[Column]:
    """A column for each sensor: readings and estimate, and below them the residual. models: readings (T, N) at the
    estimate, or else those that a monitor predicted.
    """
    model, followed = models
    columns: list[Column] = []
    readings = np.where(recording.mask, recording.outputs, np.nan)
    time = recording.time
    for i, name in enumerate(sensors):
        about: dict[str, Any] = {
            "si_unit": recording.output_units[i],
            "channel": recording.output_names[i],
            "clock": clock,
        }
        lines = [Line("measured", time, readings[:, i], SOFT, wide=any(each is not None for each in models))]
        if model is not None:
            lines.append(Line("estimate", time, model[:, i], MODEL))
        if followed is not None:
            lines.append(Line("predicted", time, followed[:, i], MODEL))
        column = [channel_signals(f"output{suffix}_{i + 1}", name, "reading", lines=lines, marks=marks, **about)]
        if model is not None:
            lines = [Line("measured − estimate", time, readings[:, i] - model[:, i], MODEL)]
            words = f"residual{suffix}_{i + 1}", f"{name}: residual", "measured − estimate"
            column.append(channel_signals(*words, lines=lines, level=0.0, height=FLAT, **about))
        columns.append(tuple(column))
    return columns


def _misfit_table(recording: Signals, sensors: Sequence[str], model: np.ndarray) -> Markup:
    """Root mean square, mean, largest residual, and Pearson correlation of each sensor."""
    rows = []
    for i, name in enumerate(sensors):
        unit, scale = display_unit(recording.output_units[i], recording.output_names[i])
        counted = recording.mask[:, i] & np.isfinite(model[:, i])
        read, estimate = scale * recording.outputs[counted, i], scale * model[counted, i]
        residual = read - estimate if len(read) else np.array([np.nan])
        statistics = (np.sqrt(np.mean(residual**2)), np.mean(residual), np.max(np.abs(residual)))
        varies = len(read) > 1 and np.ptp(read) > 0 and np.ptp(estimate) > 0
        correlation = f"{float(np.corrcoef(read, estimate)[0, 1]):.6f}" if varies else "–"
        rows.append((name, unit or "1", len(read), *map(float, statistics), correlation))
    header = ("sensor", "unit", "readings", "root mean square", "mean", "largest", "correlation")
    return shown(Table(header, rows, digits=3))


BINS = 24
COLOURS = {"recalibrated": OTHER, "augmented": MODEL}


def _compared_models(material: Material) -> dict[str, str]:
    """Names of the models whose residuals the page compares: without the causes and, if there are any, with them."""
    names = model_names(material.answer)
    return {model: names[model] for model in COLOURS if model in names}


def holdout_section(material: Material) -> Section | None:
    """Residuals of the hold-outs for each model, sensor by sensor."""
    if not material.recordings:
        return None
    blocks: list[str | list[Picture]] = []
    count = 0
    while f"{holdout_prefix(count)}_time" in material.arrays:
        pictures = _holdout_panels(material, holdout_prefix(count))
        blocks += [pictures] if pictures else []
        count += 1
    causes = len(_compared_models(material)) > 1
    words = f"Residuals{' of each model' if causes else ''} on readings that were not used for fitting."
    return Section("Before and after" if causes else "Hold-out", [words, *blocks]) if blocks else None


def _holdout_panels(material: Material, prefix: str) -> list[Picture]:
    arrays, recording, pictures = material.arrays, material.recordings[0], []
    time, read = arrays[f"{prefix}_time"], arrays[f"{prefix}_read"]
    title = prefix.replace("holdout", "hold-out").replace("_", " ")
    for i, name in enumerate(recording.output_names):
        lines: list[Line] = []
        for model, named in _compared_models(material).items():
            predicted = arrays.get(f"{prefix}_{model}")
            if predicted is not None:
                lines.append(Line(named, time, read[:, i] - predicted[:, i], COLOURS[model]))
        if lines:
            about = f"{prefix}_{i + 1}", f"{material.channel_words(name)}, {title}", "measured − model"
            unit, clock = recording.output_units[i], clock_of(prefix)
            pictures.append(channel_signals(*about, unit, lines, name, level=0.0, clock=clock))
    return pictures


def profile_section(material: Material) -> Section | None:
    """Size of the residual in units of the sensors' noise, over each variable it may depend on."""
    if not material.recordings:
        return None
    recording = material.recordings[0]
    names = _compared_models(material)
    each = {model: _excess(material, recording, model) for model in names}
    excess = {model: residual for model, residual in each.items() if residual is not None}
    if not excess:
        return None
    pictures = []
    varied = (v for v in _variables(material, recording) if np.nanmin(v[2]) < np.nanmax(v[2]))
    for k, (title, label, variable) in enumerate(varied):
        lines = [Line(names[m], *_binned(variable, size), COLOURS[m]) for m, size in excess.items()]
        chart = Chart(title, label, "residual, × noise", lines, log=True, level=1.0, from_zero=True)
        pictures.append(signals(f"gap_by_{k + 1}", chart))
    words = "Root mean square residual of all sensors, each divided by its noise; 1 means noise only."
    return Section("What the gap depends on", [words, pictures])


def _excess(material: Material, recording: Signals, model: str) -> np.ndarray | None:
    """Squared residual over squared noise, mean over the sensors (T,)."""
    predicted = material.arrays.get(model)
    if predicted is None or predicted.shape != recording.outputs.shape:
        return None
    read = np.where(recording.mask, recording.outputs, np.nan)
    ratio = ((read - predicted) / _noise(material, recording, read)) ** 2
    counted = np.isfinite(ratio)
    return np.where(counted, ratio, 0.0).sum(1) / np.maximum(counted.sum(1), 1)


def _noise(material: Material, recording: Signals, read: np.ndarray) -> np.ndarray:
    """Noise (N,) by which the diagnosis weighed each sensor, rounding included; of the samples where it is unknown."""
    stated = material.answer.get("noise") or {}
    names = {s.column: s.name for s in material.plant.sensors} if material.plant is not None else {}
    std = [as_float((stated.get(names.get(c, c)) or {}).get("std")) for c in recording.output_names]
    readings = torch.from_numpy(read)
    of_samples = sample_noise(readings.nan_to_num(), torch.isfinite(readings).double()).clamp(min=1e-12)
    return np.where(np.array(std) > 0.0, std, of_samples.numpy())


def _variables(material: Material, recording: Signals) -> Iterator[tuple[str, str, np.ndarray]]:
    """Title, axis label and values (T,) of each variable that the gap may depend on."""
    yield "By time", "time, s", recording.time
    for i, name in enumerate(map(material.channel_words, recording.output_names)):
        unit, scale = shown_unit(recording.output_units[i], recording.output_names[i])
        yield f"By {name}", axis(f"{name} measured", unit), scale * recording.outputs[:, i]
    for i, name in enumerate(map(material.channel_words, recording.input_names)):
        unit, scale = shown_unit(recording.input_units[i], recording.input_names[i])
        yield f"By {name}", axis(f"{name} commanded", unit), scale * recording.inputs[:, i]
    for name, head in _heads(material, recording):
        unit, scale = shown_unit("m")
        yield f"By the head along {name}", axis("head along the pipe", unit), scale * head


def _heads(material: Material, recording: Signals) -> Iterator[tuple[str, np.ndarray]]:
    """Level difference in m across each pipe between two tanks with sensors."""
    if material.plant is None:
        return
    levels = {}
    for sensor in material.plant.sensors:
        if sensor.column in recording.output_names:
            read = recording.outputs[:, recording.output_names.index(sensor.column)]
            levels[sensor.tank] = (read - sensor.offset) / sensor.gain
    for pipe in material.plant.pipes:
        if pipe.source in levels and pipe.target in levels and not pipe.free_fall:
            yield pipe.name, levels[pipe.source] - levels[pipe.target]


def _binned(variable: np.ndarray, squares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Root mean of `squares` by value of the variable if it has few values, otherwise in bins of equal counts."""
    usable = np.isfinite(variable) & np.isfinite(squares)
    variable, squares = variable[usable], squares[usable]
    values, index = np.unique(variable, return_inverse=True)
    if len(values) > BINS:
        edges = np.quantile(variable, np.linspace(0.0, 1.0, BINS + 1)[1:-1])
        index = np.searchsorted(edges, variable)
    count = np.maximum(np.bincount(index, minlength=1), 1)
    x, y = (np.bincount(index, weights=w) / count for w in (variable, squares))
    kept = np.bincount(index, minlength=1) > 0
    return x[kept], np.sqrt(y[kept])
