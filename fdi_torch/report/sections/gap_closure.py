"""Sections about what follows from a gap diagnosis: the closure on data not used for fitting, the calibration
constants, the discrepancy as a function of the component's own variables, the limits of a recording's inputs, and the
next experiment.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from fdi_torch.gap.verdict_words import closed_sentence, explanation_words
from fdi_torch.report.chart import PLANNED, Line
from fdi_torch.report.gap_tables import (
    HARDLY_SHOWN,
    absorbed_sentence,
    constant_table,
    error_tables,
    has_causes,
    hidden_effects,
    inseparable_pairs,
    reference_models,
    reliability_sentences,
)
from fdi_torch.report.html import bullets, folded, short, shown, tag
from fdi_torch.report.material import Material
from fdi_torch.report.numbers import as_float, as_vector, axis, number, shown_unit
from fdi_torch.report.section import Picture, Section, channel_signals
from fdi_torch.report.style import MARK, MODEL, SOFT, bar_panel, label_lines, panel


def closure_section(material: Material) -> Section | None:
    """Errors on data that no fit has seen, if there are causes that could close a gap."""
    closure = material.answer.get("closure") or {}
    stages = reference_models(material.answer)
    if not stages or not has_causes(material.answer):
        return None
    unit = str(closure.get("unit", ""))
    names = list(stages.values())
    values = [float(closure[name]) for name in stages]
    texts = [f"{number(v, 3)} {unit}".rstrip() for v in values]
    label = axis("error on hold-outs (rms)", unit)
    figure = bar_panel("", label, names, values, texts, [name == "augmented" for name in stages])
    return Section("How far it closes", [closed_sentence(closure), [Picture("gap_closure", figure)]], lead=True)


def errors_section(material: Material) -> Section | None:
    """The errors behind the closure: by model and sensor, and by hold-out."""
    blocks = [*map(shown, error_tables(material.answer))]
    sentence = absorbed_sentence(material.answer)
    return Section("Errors on data not used for fitting", [*blocks, *filter(None, [sentence])]) if blocks else None


def constants_section(material: Material) -> Section | None:
    """Nominal value of each calibration constant, and its values without and with the causes, if there are any."""
    constants = constant_table(material.answer)
    words = "Constants with a tolerance are always refitted; a value far outside it compensates for a model error."
    return Section("Calibration constants", [words, shown(constants)]) if len(constants) else None


MOST_LISTED = 40


def next_input_section(material: Material) -> Section | None:
    """The experiment that would distinguish the two likeliest explanations."""
    proposal = material.answer.get("next_input")
    if not isinstance(proposal, dict) or not isinstance(proposal.get("input"), dict):
        return None
    steps = {name: c for name, c in proposal["input"].items() if isinstance(c, dict) and "at" in c}
    units, end = proposal["input"].get("unit") or {}, as_float(proposal["input"].get("duration"))
    pictures = []
    for k, (name, channel) in enumerate(steps.items()):
        time, values = as_vector(channel["at"]), as_vector(channel["value"])
        line = Line("command", np.append(time, end), np.append(values, values[-1:]), MODEL, steps=True)
        words = f"gap_next_input_{k + 1}", material.channel_words(name), "command"
        pictures.append(channel_signals(*words, str(units.get(name, "")), [line], name, clock=PLANNED))
    return Section("Next experiment", [_next_words(proposal), pictures])


def limits_section(material: Material) -> Section | None:
    """Effects that these inputs hide or confuse, and how often another cause would have got this name."""
    blocks: list[Any] = reliability_sentences(material.answer)
    small = "Effects that these inputs hardly show"
    same = "Pairs of effects with the same signature under these inputs"
    for title, items in {small: hidden_effects(material.answer), same: inseparable_pairs(material.answer)}.items():
        meaning = [tag("p", f"{HARDLY_SHOWN[:1].upper()}{HARDLY_SHOWN[1:]}.")] if title == small else []
        blocks += [folded(f"{title}: {len(items)}", *meaning, *bullets(items[:MOST_LISTED]))] if items else []
    return Section("Limits of these inputs", blocks) if blocks else None


def _next_words(proposal: Mapping[str, Any]) -> str:
    between = [explanation_words(causes) for causes in proposal.get("between") or []]
    rivals = " from ".join(between) if len(between) == 2 else "the best two explanations"
    words = f"Of step inputs within the limits of pumps and levels, this one separates {rivals} most."
    when, samples = proposal.get("parted_after"), proposal.get("parted_after_samples")
    if not isinstance(when, int | float):
        return f"{words} It is too short to distinguish them with certainty."
    count = f" ({samples} samples)" if isinstance(samples, int) else ""
    return f"{words} They are expected to be distinguishable after {number(float(when))} s{count}."


MOST_CURVES = 12
QUANTITIES = {"flow": "flow added", "area": "cross-section added", "reading": "added to the reading"}


def curves_section(material: Material) -> Section | None:
    """One panel for each variable of each component with a discrepancy."""
    curves = [c for c in material.answer.get("curves") or [] if isinstance(c, dict)][:MOST_CURVES]
    if not curves:
        return None
    pictures = [Picture(f"gap_curve_{k + 1}", curve_panel(curve)) for k, curve in enumerate(curves)]
    words = "Discrepancy between the component and the plant file, averaged at equal values of its variable. "
    if any("effect" in curve for curve in curves):
        words += (
            "Blue: a free function with two standard errors, estimated without the library; orange: the named cause. "
            "Where both agree, the readings do not contradict the cause's equation. A free function has no memory and "
            "hardly shows lags or delays."
        )
    else:
        words += "The free function, with two standard errors, shows what an unnamed cause would have to do."
    return Section("The discrepancy", [words, pictures])


def curve_panel(curve: Mapping[str, Any]) -> Figure:
    """Free function with its band, and the effect."""
    unit, scale = shown_unit(str(curve.get("unit", "")))
    quantity = str(curve.get("quantity", ""))
    y_unit, y_scale = ("%", 100.0) if quantity == "area" else shown_unit(str(curve.get("quantity_unit", "")))
    x, free, std = scale * as_vector(curve["at"]), y_scale * as_vector(curve["free"]), as_vector(curve["free_std"])
    name = short(curve.get("variable", ""), 30)
    label = axis(QUANTITIES.get(quantity, "added"), y_unit)
    figure, axes = panel(f"{short(curve.get('location', ''), 20)}: by {name}", axis(name, unit), label)
    axes.axhline(0.0, color=SOFT, lw=0.8)
    axes.fill_between(x, free - 2.0 * y_scale * std, free + 2.0 * y_scale * std, color=MODEL, alpha=0.2, lw=0.0)
    axes.plot(x, free, color=MODEL, lw=1.4, label="free function")
    if "effect" in curve:
        axes.plot(x, y_scale * as_vector(curve["effect"]), color=MARK, lw=1.4, ls="--", label="cause")
        label_lines(axes)
    return figure
