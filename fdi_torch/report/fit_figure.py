"""The picture of a fit: what was read, what the estimate predicts, and what is left."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from fdi_torch.parameters import display_unit
from fdi_torch.recording import Recording

READ, PREDICTED, LEFT = "#8a94a6", "#c2410c", "#1d4ed8"
MOST_POINTS = 4000


def fit_figure(recording: Recording, predicted: Tensor, title: str) -> Figure:
    """Readings against prediction above, residuals below, one column a sensor. predicted (T, N) in SI."""
    count = len(recording.output_names)
    figure = Figure(figsize=(max(4.2 * count, 6.0), 5.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, count, sharex=True, squeeze=False, height_ratios=(2, 1))
    every = max(len(recording) // MOST_POINTS, 1)
    time = recording.time.numpy()[::every]
    for i, name in enumerate(recording.output_names):
        unit, scale = display_unit(recording.output_units[i])
        seen = scale * np.where(recording.mask[:, i].numpy(), recording.outputs[:, i].numpy(), np.nan)[::every]
        model = scale * predicted[:, i].detach().numpy()[::every]
        upper, lower = axes[0, i], axes[1, i]
        upper.plot(time, seen, ".", ms=2, color=READ, label="read")
        upper.plot(time, model, lw=1.4, color=PREDICTED, label="estimate")
        lower.plot(time, seen - model, lw=0.6, color=LEFT)
        lower.axhline(0.0, lw=0.6, color="black")
        upper.set_title(name)
        upper.set_ylabel(f"{name} [{unit or '1'}]")
        lower.set_ylabel(f"residual [{unit or '1'}]")
        lower.set_xlabel("time [s]")
        upper.grid(alpha=0.25)
        lower.grid(alpha=0.25)
    axes[0, 0].legend(frameon=False)
    figure.suptitle(title)
    return figure


def save(figure: Figure, path: Path) -> Path:
    """Writes the picture as PNG or SVG, by the path's ending."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130, metadata={"Software": None} if path.suffix == ".png" else None)
    return path
