"""Sections about the estimation: global search, then refinement."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fdi_torch.names import counted
from fdi_torch.report.chart import Chart, Line
from fdi_torch.report.material import Material, Payload
from fdi_torch.report.numbers import axis, number, shown_unit
from fdi_torch.report.section import Picture, Section, signals
from fdi_torch.report.sections.estimate import last_estimate
from fdi_torch.report.style import MARK, MODEL, OTHER, SOFT

GENERATIONS, ITERATIONS = "/estimator/de/generation", "/estimator/refine/iteration"
MOST_PARAMETERS = 6


def search_section(material: Material) -> Section | None:
    """Cost and best member of differential evolution over its generations."""
    events = [m for m in material.of(GENERATIONS) if not m.get("problem")]
    if len(events) < 2:
        return None
    steps = column(events, "generation")
    lines = [Line("best", steps, column(events, "best_cost"), MODEL)]
    mean = column(events, "mean_cost")
    if np.isfinite(mean).any():
        lines.append(Line("mean", steps, mean, SOFT))
    chart = Chart("Cost", "generation", "cost", lines, log=True, clock="search")
    pictures = [signals("search_cost", chart)]
    pictures += _best_members(material, events, steps)
    last = events[-1]
    words = f"Differential evolution, {int(steps[-1])} generations"
    words += f", {last['evaluations']} simulations" if last.get("evaluations") else ""
    return Section("Search", [f"{words}; lowest cost {number(float(last['best_cost']))}.", pictures])


def refinement_section(material: Material) -> Section | None:
    """Cost of each start over the iterations of the refinement."""
    events = material.of(ITERATIONS)
    if not events:
        return None
    lanes = sorted({int(m.get("problem", 0)) for m in events})[:4]
    colours = (MODEL, OTHER, MARK, SOFT)
    lines: list[Line] = []
    for colour, lane in zip(colours, lanes, strict=False):
        start = [m for m in events if int(m.get("problem", 0)) == lane]
        lines.append(Line(f"start {lane + 1}", np.arange(len(start)), column(start, "cost"), colour))
    chart = Chart("Cost", "iteration", "cost", lines, log=True)
    lowest = float(np.nanmin(column(events, "cost")))
    words = f"{counted(len(events), 'iteration')} from {counted(len(lanes), 'start')}; lowest cost {number(lowest, 6)}."
    return Section("Refinement", [words, [signals("refinement_cost", chart)]])


def column(events: Sequence[Payload], name: str) -> np.ndarray:
    """A number of each message, NaN where it is missing."""
    values = (m.get(name) for m in events)
    return np.array([float(v) if isinstance(v, int | float) else np.nan for v in values])


def _best_members(material: Material, events: Sequence[Payload], steps: np.ndarray) -> list[Picture]:
    """Parameters of the best member over the generations."""
    final = last_estimate(material)
    names = [str(name) for name in (final or {}).get("names", ()) if name in events[-1]][:MOST_PARAMETERS]
    pictures = []
    for k, name in enumerate(names):
        unit, scale = shown_unit(material.unit(GENERATIONS, name))
        lines = [Line("best member", steps, scale * column(events, name), MODEL)]
        if name in material.truth:
            lines.append(
                Line("simulated", steps, np.full(len(steps), scale * material.truth[name]), OTHER, dashed=True)
            )
        chart = Chart(name, "generation", axis("best member", unit), lines, clock="search")
        pictures.append(signals(f"search_parameter_{k + 1}", chart))
    return pictures
