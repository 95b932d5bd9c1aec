"""Sections about an estimation: search, refinement, the table of the estimate, the faults that are present, and its
uncertainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from fdi_torch.amounts import end_words
from fdi_torch.effects import build_network
from fdi_torch.estimate.misfit import NOT_ESTABLISHED, flow_words
from fdi_torch.names import counted
from fdi_torch.plant.exact_constants import exact_constants_sentence, without_tolerance_sentence
from fdi_torch.report.chart import Chart, Line
from fdi_torch.report.diagnosed_effects import combinations_of, diagnosed_effects, rivals_of
from fdi_torch.report.html import bullets, shown, table, tag
from fdi_torch.report.material import Material, Payload
from fdi_torch.report.numbers import correlation_table, estimate_table, shown_unit, signed
from fdi_torch.report.section import Picture, Section, channel_signals, signals
from fdi_torch.report.style import MARK, MODEL, OTHER, SOFT, ellipse_panel

MOST_ELLIPSES = 6


def estimate_section(material: Material) -> Section | None:
    """Values with standard errors and 95 % intervals, and the simulated values if known."""
    final = last_estimate(material)
    if final is None:
        return None
    names, units = [str(name) for name in final["names"]], final.get("units") or [""] * len(final["names"])
    combinations = combinations_of(material, "combinations")
    truth = {"simulated": material.truth} if material.truth else {}
    numbers = (names, units, final["values"], final["std"])
    estimates = estimate_table("", *numbers, **material.limits, combinations=combinations, exact=truth)
    deviating = () if material.unexplained else combinations_of(material, "not_isolated")
    findings = [_finding(material, name) for name in names]
    findings += [tag("span", "present", class_="bad") if c in deviating else "" for c in combinations]
    rows = [[name, finding, *row] for finding, (name, *row) in zip(findings, estimates.rows, strict=True)]
    header = ("parameter", "finding", *estimates.header[1:])
    notes = [] if material.unexplained else [s for rivals in rivals_of(material) for s in rivals.sentences]
    notes += [str(note) for note in final.get("unidentifiable") or ()]
    notes += [end_words(str(name), material.run.at_bounds.get(str(name), "")) for name in final.get("at_bound") or ()]
    if material.plant is not None:
        constants = build_network(material.plant).constants.names
        claims = any(f.present for f in diagnosed_effects(material)) or deviating or rivals_of(material)
        exact = [exact_constants_sentence(material.plant, names, constants)] if material.truth else []
        exact += [without_tolerance_sentence(material.plant, names, constants)] if claims else []
        notes += [remark for remark in exact if remark]
    return Section("Estimate", [table(header, rows, left=3), *_water(material), *bullets(notes)], lead=True)


def posterior_section(material: Material) -> Section | None:
    """Ellipses of the most correlated pairs, and the correlation matrix."""
    final = last_estimate(material)
    if final is None or len(final["names"]) < 2:
        return None
    names, covariance = final["names"], covariance_of(final)
    if covariance is None:
        return None
    std = np.sqrt(np.diag(covariance))
    determined = [i for i in range(len(names)) if np.isfinite(std[i]) and std[i] > 0]
    with np.errstate(invalid="ignore"):  # undetermined parameters have no correlation
        correlation = covariance / np.outer(std, std)
    ranked = sorted(combinations(determined, 2), key=lambda pair: -abs(correlation[pair]))[:MOST_ELLIPSES]
    pictures = [_ellipse(material, final, covariance, pair, k) for k, pair in enumerate(ranked)]
    words = "Regions with 50 % and 95 % of the probability, most correlated pairs first."
    words += " The green cross marks the simulated values." if material.truth else ""
    grid = shown(replace(correlation_table(names, covariance), title=""))
    return Section("Uncertainty", [words, pictures, grid]) if pictures else None


def last_estimate(material: Material) -> Payload | None:
    """The last final estimate, of the first problem if there are several."""
    finals = [m for m in material.of("/estimate/final") if not m.get("problem")]
    return finals[-1] if finals else None


def covariance_of(final: Payload) -> np.ndarray | None:
    """Covariance (P, P); None if the message has none of that size."""
    flat, count = np.asarray(final.get("covariance", ()), dtype=float), len(final["names"])
    return flat.reshape(count, count) if flat.size == count * count else None


def _finding(material: Material, name: str) -> Any:
    """Result of the test of a fault size, in words; empty for other parameters."""
    for finding in diagnosed_effects(material):
        if name in (prefix := f"{finding.location}.{finding.effect}", f"{prefix}.size"):
            if material.unexplained:
                return NOT_ESTABLISHED
            if finding.present:
                return tag("span", "present", class_="bad")
            not_isolated = any(name in c.parameters for c in combinations_of(material, "not_isolated"))
            not_isolated |= any(name in rivals.names for rivals in rivals_of(material))
            return tag("span", "not isolated", class_="bad") if not_isolated else "not found"
    return ""


def _water(material: Material) -> list[Any]:
    """Sizes as flows and equivalent holes, if the log has them."""
    moving = [f for f in diagnosed_effects(material) if f.present and np.isfinite(f.flow)]
    return bullets(f"{f.words} {flow_words(f.flow, f.hole, not material.unexplained)}" for f in moving)


def _ellipse(material: Material, final: Payload, covariance: np.ndarray, pair: tuple[int, int], k: int) -> Picture:
    i, j = pair
    names = (str(final["names"][i]), str(final["names"][j]))
    known = [final["units"][n] if final.get("units") else "" for n in pair]
    units, scales = zip(*map(shown_unit, known, names), strict=True)
    scale = np.array(scales)
    centre = scale * np.array([final["values"][i], final["values"][j]], dtype=float)
    part = covariance[np.ix_(pair, pair)] * np.outer(scale, scale)
    simulated = all(name in material.truth for name in names)
    truth = (scales[0] * material.truth[names[0]], scales[1] * material.truth[names[1]]) if simulated else None
    rho = part[0, 1] / np.sqrt(part[0, 0] * part[1, 1])
    return Picture(f"ellipse_{k + 1}", ellipse_panel(names, units, centre, part, truth), f"correlation {signed(rho)}")


COST = "The cost measures the misfit of model and readings; only its decrease means something, and it ends level."
GENERATIONS, ITERATIONS = "/estimator/de/generation", "/estimator/refine/iteration"
MOST_PARAMETERS = 6


def search_section(material: Material) -> Section | None:
    """Cost and best candidate of differential evolution over its generations."""
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
    return Section("Search", [f"{words}. {COST}", pictures])


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
    words = f"{counted(len(events), 'iteration')} from {counted(len(lanes), 'start')}. {COST}"
    return Section("Refinement", [words, [signals("refinement_cost", chart)]])


def column(events: Sequence[Payload], name: str) -> np.ndarray:
    """A number of each message, NaN where it is missing."""
    values = (m.get(name) for m in events)
    return np.array([float(v) if isinstance(v, int | float) else np.nan for v in values])


def _best_members(material: Material, events: Sequence[Payload], steps: np.ndarray) -> list[Picture]:
    """Parameters of the best candidate over the generations."""
    final = last_estimate(material)
    names = [str(name) for name in (final or {}).get("names", ()) if name in events[-1]][:MOST_PARAMETERS]
    pictures = []
    for k, name in enumerate(names):
        lines = [Line("best so far", steps, column(events, name), MODEL)]
        if name in material.truth:
            lines.append(Line("simulated", steps, np.full(len(steps), material.truth[name]), OTHER, dashed=True))
        about, unit = (f"search_parameter_{k + 1}", name, "best so far"), material.unit(GENERATIONS, name)
        pictures.append(channel_signals(*about, unit, lines, x_label="generation", clock="search"))
    return pictures
