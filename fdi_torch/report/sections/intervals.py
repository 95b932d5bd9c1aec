"""Section about intervals beyond the standard errors: profile likelihoods, and draws from the posterior."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from fdi_torch.amounts import interval_words
from fdi_torch.estimate.uncertainty import chi_square_quantile
from fdi_torch.quantities import display_unit
from fdi_torch.report.chart import Chart, Line
from fdi_torch.report.html import bullets, table
from fdi_torch.report.material import Material
from fdi_torch.report.numbers import UNLIMITED, as_float, as_vector, axis, number
from fdi_torch.report.section import Column, Picture, Section, signals
from fdi_torch.report.sections.estimate import last_estimate
from fdi_torch.report.style import MODEL, OTHER

MOST_PANELS = 12
FARTHEST = 6  # ratio that is drawn, in units of the ratio at the limits
TAIL = 0.025  # of the draws on either side of a 95 % interval


def intervals_section(material: Material) -> Section | None:
    """The limits by each method side by side, and the likelihood ratio and the draws of each parameter."""
    profiles = {str(p["name"]): p for p in material.listed("profiles") if isinstance(p, dict)}
    final, draws = last_estimate(material), _draws(material)
    if final is None or not (profiles or draws):
        return None
    ranges, ends = material.run.ranges, material.run.at_bounds
    rows: list[list[str]] = []
    pictures: list[Column] = []
    for i, name in enumerate(map(str, final["names"])):
        if name not in profiles and name not in draws:
            continue
        unit, scale = display_unit(final["units"][i] if final.get("units") else "", name)
        value, std = (scale * float(final[key][i]) for key in ("values", "std"))
        low, high = (scale * limit for limit in ranges.get(name, UNLIMITED))
        standard = interval_words(value, std, low, high, ends.get(name, ""), number)
        rows.append([name, unit or "1", standard, *_limits(profiles.get(name), draws.get(name), scale)])
        pictures.append(_column(name, unit, scale, profiles.get(name), draws.get(name), len(pictures)))
    words = (
        "Standard errors assume a likelihood that is quadratic about the estimate. The profile is the likelihood ratio "
        "with all other parameters fitted again; its limits lie where it crosses the horizontal line. Draws are from "
        "the posterior; 2.5 % lie beyond either limit. Where the intervals differ, the profile or the draws hold."
    )
    notes = [str(note) for each in profiles.values() for note in each.get("warnings") or ()]
    notes += [str(note) for note in material.listed("draws.warnings")]
    header = ["parameter", "unit", "standard error, 95 %", "profile", "draws, 95 %", "remark"]
    return Section(
        "Intervals", [words, *bullets(notes, class_="bad"), table(header, rows, left=2), pictures[:MOST_PANELS]]
    )


def _draws(material: Material) -> dict[str, np.ndarray]:
    """The draws of each parameter, SI; empty if the log has none."""
    values, final = material.arrays.get("draws"), last_estimate(material)
    if values is None or final is None or values.ndim != 3 or values.shape[-1] != len(final["names"]):
        return {}
    flat = values.reshape(-1, values.shape[-1]).astype(float)
    return {str(name): flat[np.isfinite(flat[:, i]), i] for i, name in enumerate(final["names"])}


def _limits(profile: Mapping[str, Any] | None, draws: np.ndarray | None, scale: float) -> list[str]:
    """The interval of the profile, that of the draws, and a remark."""
    cells = ["", "", ""]
    if profile is not None:
        level = f" ({100.0 * as_float(profile.get('confidence')):g} %)"
        cells[0] = _interval(*(scale * as_float(profile.get(end)) for end in ("low", "high"))) + level
        cells[2] = "; ".join(f"the {end} end is the end of its range" for end in profile.get("ends") or ())
    if draws is not None and len(draws):
        cells[1] = _interval(*(scale * np.quantile(draws, (TAIL, 1.0 - TAIL))))
    return cells


def _interval(low: float, high: float) -> str:
    return f"{number(low)} … {number(high)}"


def _column(
    name: str, unit: str, scale: float, profile: Mapping[str, Any] | None, draws: np.ndarray | None, k: int
) -> Column:
    pictures: list[Picture] = []
    if profile is not None:
        level = chi_square_quantile(as_float(profile.get("confidence")))
        x, ratio = scale * as_vector(profile.get("x")), as_vector(profile.get("ratio"))
        near = ratio <= FARTHEST * level
        line = Line("likelihood ratio", x[near], ratio[near], MODEL)
        chart = Chart(name, axis(name, unit), "likelihood ratio", [line], level=level, from_zero=True)
        pictures.append(signals(f"profile_{k + 1}", chart, f"profile likelihood of {name}"))
    if draws is not None and len(draws):
        counts, edges = np.histogram(scale * draws, bins="sqrt" if len(draws) < 900 else 30)
        bars = Line("draws", edges, np.append(counts, 0.0) / len(draws), OTHER, steps=True)
        title = name if profile is None else ""
        chart = Chart(title, axis(name, unit), "share of the draws", [bars], from_zero=True)
        pictures.append(signals(f"draws_{k + 1}", chart, f"draws of {name}"))
    return tuple(pictures)
