"""What was read and commanded, against what the estimate predicts."""

from __future__ import annotations

import numpy as np

from fdi_torch.logbook import Signals
from fdi_torch.report.curves import held_steps
from fdi_torch.report.html import table
from fdi_torch.report.material import Material
from fdi_torch.report.numbers import axis, number, shown_unit
from fdi_torch.report.panels import Line, line_panel, residual_panel
from fdi_torch.report.predictions import predicted
from fdi_torch.report.section import Picture, Section
from fdi_torch.report.style import MODEL, SOFT


def fit_section(material: Material) -> Section | None:
    """Outputs against estimate and what is left, one panel a sensor; outputs alone where nothing was predicted."""
    blocks: list[str | list[Picture]] = []
    fitted = False
    for k, recording in enumerate(material.recordings):
        several = len(material.recordings) > 1
        model = predicted(material.arrays, k, several, recording.outputs.shape, material.groups[k])
        fitted |= model is not None
        blocks += [f"Recording {material.groups[k] or 'diagnosed'}".replace("_", " ")] if several else []
        blocks.append(_output_panels(recording, model, f"_{k + 1}" if several else ""))
        if model is not None:
            blocks += [_misfit_table(recording, model)]
    if not blocks:
        return None
    return Section("Readings against the estimate" if fitted else "Readings", blocks)


def inputs_section(material: Material) -> Section | None:
    """What was commanded; panels where it moves, words where it is constant."""
    blocks: list[str | list[Picture]] = []
    for k, recording in enumerate(material.recordings):
        suffix = f"_{k + 1}" if len(material.recordings) > 1 else ""
        pictures, constant = [], []
        for i, name in enumerate(recording.input_names):
            unit, scale = shown_unit(recording.input_units[i])
            values = scale * recording.inputs[:, i]
            if np.isfinite(values).any() and np.nanmin(values) == np.nanmax(values):
                constant.append(f"{name} at {number(float(np.nanmax(values)))} {unit}".rstrip())
                continue
            time, corners = _steps(recording, values)
            figure = line_panel(name, "time, s", axis("command", unit), [(name, time, corners, MODEL)])
            figure.axes[0].lines[0].set_drawstyle("steps-post" if recording.hold == "zero_order" else "default")
            pictures.append(Picture(f"input{suffix}_{i + 1}", figure))
        blocks += [f"Held throughout: {', '.join(constant)}."] if constant else []
        blocks += [pictures] if pictures else []
    return Section("Inputs", blocks) if blocks else None


def _steps(recording: Signals, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return held_steps(recording.time, values) if recording.hold == "zero_order" else (recording.time, values)


def _output_panels(recording: Signals, model: np.ndarray | None, suffix: str) -> list[Picture]:
    pictures = []
    readings = np.where(recording.mask, recording.outputs, np.nan)
    for i, name in enumerate(recording.output_names):
        unit, scale = shown_unit(recording.output_units[i])
        lines: list[Line] = [("read", recording.time, scale * readings[:, i], SOFT)]
        if model is not None:
            lines.append(("estimate", recording.time, scale * model[:, i], MODEL))
        figure = line_panel(name, "time, s", axis("reading", unit), lines)
        pictures.append(Picture(f"output{suffix}_{i + 1}", figure))
    for i, name in enumerate(recording.output_names if model is not None else ()):
        unit, scale = shown_unit(recording.output_units[i])
        left = scale * (readings[:, i] - model[:, i])  # type: ignore[index]
        figure = residual_panel(f"{name}: what is left", axis("read − estimate", unit), recording.time, left)
        pictures.append(Picture(f"residual{suffix}_{i + 1}", figure))
    return pictures


def _misfit_table(recording: Signals, model: np.ndarray) -> str:
    """Root mean square, mean, largest residual, and Pearson correlation of each sensor."""
    rows = []
    for i, name in enumerate(recording.output_names):
        unit, scale = shown_unit(recording.output_units[i])
        counted = recording.mask[:, i] & np.isfinite(model[:, i])
        read, said = scale * recording.outputs[counted, i], scale * model[counted, i]
        left = read - said
        rows.append([name, unit or "1", str(int(counted.sum())), *_statistics(left), _correlation(read, said)])
    header = ("sensor", "unit", "readings", "root mean square", "mean", "largest", "correlation")
    return table(header, rows, left=2)


def _statistics(left: np.ndarray) -> list[str]:
    if not len(left):
        return ["–"] * 3
    return [number(float(v), 3) for v in (np.sqrt(np.mean(left**2)), np.mean(left), np.max(np.abs(left)))]


def _correlation(read: np.ndarray, said: np.ndarray) -> str:
    """A dash where one of both is constant."""
    if len(read) < 2 or np.ptp(read) == 0 or np.ptp(said) == 0:
        return "–"
    return f"{float(np.corrcoef(read, said)[0, 1]):.6f}"
