"""Sections about the signals: inputs, readings, predictions and residuals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from fdi_torch.logbook import Signals
from fdi_torch.report.chart import Line, corner_points
from fdi_torch.report.html import table, tag
from fdi_torch.report.material import Material
from fdi_torch.report.numbers import amount, number, shown_unit
from fdi_torch.report.predictions import predicted
from fdi_torch.report.section import Column, Picture, Section, channel_signals
from fdi_torch.report.style import MODEL, SOFT


def fit_section(material: Material) -> Section | None:
    """Readings, predictions and residuals of each sensor; readings only if the log has no predictions."""
    blocks: list[str | list[Column]] = []
    fitted = False
    for k, (recording, group) in enumerate(zip(material.recordings, material.groups, strict=True)):
        several = len(material.recordings) > 1
        model = predicted(material, k)
        fitted |= model is not None
        blocks += [tag("h4", recording_name(group))] if several else []
        sensors = [material.channel_words(name) for name in recording.output_names]
        blocks.append(_output_panels(recording, sensors, model, f"_{k + 1}" if several else "", clock_of(group)))
        if model is not None:
            blocks += [_misfit_table(recording, sensors, model)]
    if not blocks:
        return None
    return Section("Readings against the estimate" if fitted else "Readings", blocks)


def inputs_section(material: Material) -> Section | None:
    """Inputs: panels for those that vary, text for constant ones."""
    blocks: list[str | list[Picture]] = []
    for k, (recording, group) in enumerate(zip(material.recordings, material.groups, strict=True)):
        several = len(material.recordings) > 1
        suffix = f"_{k + 1}" if several else ""
        pictures, constant = [], []
        for i, name in enumerate(map(material.channel_words, recording.input_names)):
            unit, channel, values = recording.input_units[i], recording.input_names[i], recording.inputs[:, i]
            if np.isfinite(values).any() and np.nanmin(values) == np.nanmax(values):
                constant.append(f"{name} at {amount(float(np.nanmax(values)), unit, name=channel)}")
                continue
            held = recording.hold == "zero_order"
            time, corners = corner_points(recording.time, values) if held else (recording.time, values)
            line = Line("command", time, corners, MODEL, steps=held)
            title = f"{name}, {recording_name(group).lower()}" if several else name
            clock = clock_of(group)
            pictures.append(
                channel_signals(f"input{suffix}_{i + 1}", title, "command", unit, [line], channel, clock=clock)
            )
        of = f"{recording_name(group)}, constant" if several else "Constant"
        blocks += [f"{of}: {', '.join(constant)}."] if constant else []
        blocks += [pictures] if pictures else []
    return Section("Inputs", blocks) if blocks else None


def recording_name(group: str) -> str:
    """'Diagnosed recording', 'Hold-out 2': a recording of a log with several."""
    words = group.replace("_", " ").replace("holdout", "hold-out") or "diagnosed recording"
    return words[:1].upper() + words[1:]


def clock_of(group: str) -> str:
    """Name of the clock of a recording's charts."""
    return f"recording {group}"


def _output_panels(
    recording: Signals, sensors: Sequence[str], model: np.ndarray | None, suffix: str, clock: str
) -> list[Column]:
    """A column for each sensor: readings and estimate, and below them the residual."""
    columns: list[Column] = []
    readings = np.where(recording.mask, recording.outputs, np.nan)
    time = recording.time
    for i, name in enumerate(sensors):
        about: dict[str, Any] = {
            "si_unit": recording.output_units[i],
            "channel": recording.output_names[i],
            "clock": clock,
        }
        lines = [Line("measured", time, readings[:, i], SOFT, wide=model is not None)]
        if model is not None:
            lines.append(Line("estimate", time, model[:, i], MODEL))
        column = [channel_signals(f"output{suffix}_{i + 1}", name, "reading", lines=lines, **about)]
        if model is not None:
            lines = [Line("measured − estimate", time, readings[:, i] - model[:, i], MODEL)]
            words = f"residual{suffix}_{i + 1}", f"{name}: residual", "residual"
            column.append(channel_signals(*words, lines=lines, level=0.0, height=2.1, **about))
        columns.append(tuple(column))
    return columns


def _misfit_table(recording: Signals, sensors: Sequence[str], model: np.ndarray) -> str:
    """Root mean square, mean, largest residual, and Pearson correlation of each sensor."""
    rows = []
    for i, name in enumerate(sensors):
        unit, scale = shown_unit(recording.output_units[i], recording.output_names[i])
        counted = recording.mask[:, i] & np.isfinite(model[:, i])
        read, estimate = scale * recording.outputs[counted, i], scale * model[counted, i]
        residual = read - estimate
        row = [name, unit or "1", str(int(counted.sum())), *_statistics(residual), _correlation(read, estimate)]
        rows.append(row)
    header = ("sensor", "unit", "readings", "root mean square", "mean", "largest", "correlation")
    return table(header, rows, left=2)


def _statistics(residual: np.ndarray) -> list[str]:
    if not len(residual):
        return ["–"] * 3
    statistics = (np.sqrt(np.mean(residual**2)), np.mean(residual), np.max(np.abs(residual)))
    return [number(float(v), 3) for v in statistics]


def _correlation(read: np.ndarray, estimate: np.ndarray) -> str:
    """Pearson correlation; a dash if one of both is constant."""
    if len(read) < 2 or np.ptp(read) == 0 or np.ptp(estimate) == 0:
        return "–"
    return f"{float(np.corrcoef(read, estimate)[0, 1]):.6f}"
