"""Sections about what follows from a gap diagnosis: the closure on data not used for fitting, the calibration
constants, the discrepancy as a function of the component's own variables, the limits of a recording's inputs, and the
next experiment.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from fdi_torch.gap.verdict_words import closed_sentence, explanation_words
from fdi_torch.report.chart import PLANNED, Line
from fdi_torch.report.diagnosed_effects import has_causes, reference_models
from fdi_torch.report.html import bullets, folded, short, table
from fdi_torch.report.material import Material
from fdi_torch.report.numbers import as_float, as_vector, axis, number, percent, shown_unit, with_error
from fdi_torch.report.section import Picture, Section, channel_signals
from fdi_torch.report.style import MARK, MODEL, SOFT, bar_panel, label_lines, panel

FROZEN = {"recalibrated": "constants recalibrated without them", "nominal": "nominal constants"}


def closure_section(material: Material) -> Section | None:
    """Errors on data that no fit has seen, if there are causes that could close a gap."""
    closure = material.answer.get("closure") or {}
    stages = _stages(material)
    if not stages or not has_causes(material.answer):
        return None
    unit = str(closure.get("unit", ""))
    names = list(stages.values())
    values = [float(closure[name]) for name in stages]
    texts = [f"{number(v, 3)} {unit}".rstrip() for v in values]
    label = axis("free-run error on hold-outs (rms)", unit)
    figure = bar_panel("", label, names, values, texts, [name == "augmented" for name in stages])
    return Section("How far it closes", [closed_sentence(closure), [Picture("gap_closure", figure)]], lead=True)


def errors_section(material: Material) -> Section | None:
    """The errors behind the closure: by model and sensor, and by hold-out."""
    closure = material.answer.get("closure") or {}
    stages = _stages(material)
    if not stages:
        return None
    unit = str(closure.get("unit", ""))
    named = stages.get("augmented")
    frozen = (closure.get("frozen") or {}) if named else {}
    extra = [(f"{named}, {other}", as_float(frozen.get(key))) for key, other in FROZEN.items() if key in frozen]
    units, sensors = closure.get("units") or {}, {str(s): e for s, e in (closure.get("per_sensor") or {}).items()}
    several = len(set(units.values())) > 1
    header = [f"plant{', error in ' + unit if unit else ''}", "all"]
    header += [f"{s}, {units[s]}" if several and s in units else s for s in sensors]
    rows = [
        [name, *(number(e, 3) for e in (float(closure[m]), *(as_float(errors.get(m)) for errors in sensors.values())))]
        for m, name in stages.items()
    ]
    rows += [[name, number(value, 3), *[""] * (len(header) - 2)] for name, value in extra]
    blocks: list[Any] = [table(header, rows)]
    blocks += _each_holdout(closure, unit, stages)
    if extra and "ceiling" in closure:
        blocks.append(
            "Free functions of the component's own variables, added to the causes, show the best that better "
            "equations could reach. If the errors with other constants are far larger, recalibration without the "
            "causes had absorbed part of the gap; using both would count that part twice."
        )
    return Section("Errors on data not used for fitting", blocks)


def _stages(material: Material) -> dict[str, str]:
    """Names of the models that have an error, by their key in the closure."""
    closure = material.answer.get("closure") or {}
    models = reference_models(material.answer).items()
    return {key: name for key, name in models if isinstance(closure.get(key), int | float)}


def constants_section(material: Material) -> Section | None:
    """Nominal value of each calibration constant, and its values without and with the causes, if there are any."""
    constants = material.answer.get("constants") or {}
    causes = has_causes(material.answer)
    rows = []
    for name, c in constants.items():
        unit, scale = shown_unit(str(c.get("unit", "1")), str(name))
        values = {key: scale * as_float(c.get(key)) for key in ("nominal", "tolerance", "recalibrated", "augmented")}
        off = [(values[m] - values["nominal"]) / values["tolerance"] for m in ("recalibrated", "augmented")]
        fitted = with_error(values["augmented"], scale * as_float(c.get("std")))
        nominal = with_error(values["nominal"], values["tolerance"])
        without = [number(values["recalibrated"]), number(off[0], 2)] if causes else ["", ""]
        rows.append([str(name), nominal, *without, fitted, number(off[1], 2), unit])
    if not rows:
        return None
    last = "with the causes" if causes else "fitted"
    header = ["constant", "nominal", "recalibrated", "tolerances off", last, "tolerances off", "unit"]
    words = "Constants with a tolerance are always refitted; a value far outside it compensates for a model error."
    return Section("Calibration constants", [words, table(header, rows)])


def _each_holdout(closure: Mapping[str, Any], unit: str, stages: Mapping[str, str]) -> list[Any]:
    """One row per file, if there are several; the share that closes if there are causes."""
    shown = {key: name for key, name in stages.items() if key in ("recalibrated", "augmented", "noise_floor")}
    rows = []
    for one in closure.get("per_holdout") or []:
        share = one.get("closed")
        closed = percent(share) if isinstance(share, int | float) else "undefined"
        name = PurePath(str(one.get("source", ""))).name
        errors = [number(as_float(one.get(key)), 3) for key in shown]
        rows.append([name, *errors, closed if "augmented" in shown else ""])
    header = (f"hold-out, error in {unit}", *shown.values(), "closed")
    return [table(header, rows)] if rows else []


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
    excitation = material.answer.get("excitation") or {}
    confusability = material.answer.get("impostors") or {}
    blocks: list[Any] = _confusability_words(confusability)
    hidden = [explanation_words([cause]) for cause in excitation.get("hidden") or []]
    pairs = [" and ".join(explanation_words([c]) for c in p["between"]) for p in excitation.get("inseparable") or []]
    small = "Effects that these inputs do not show at their typical size"
    for title, items in ((small, hidden), ("Pairs of effects with the same signature under these inputs", pairs)):
        if items:
            blocks.append(folded(f"{title}: {len(items)}", *bullets(items[:MOST_LISTED])))
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


def _confusability_words(confusability: Mapping[str, Any]) -> list[str]:
    sentences = []
    best, unexplained = confusability.get("best"), confusability.get("left_open")
    if best and isinstance(unexplained, int | float):
        sentences.append(
            f"If the library had lacked the cause, the best explanation would have been {explanation_words(best)}, "
            f"with {percent(unexplained)} of the gap unexplained."
        )
    simulated = confusability.get("simulated")
    if isinstance(simulated, dict):
        passed_for = [explanation_words([c]) for c in simulated.get("passed_for") or []]
        mostly = f", mostly for {', '.join(passed_for[:3])}" if passed_for else ""
        rivals, draws = simulated.get("rivals"), simulated.get("draws")
        sentences.append(
            f"Reliability of the name: of {draws} recordings simulated with linearized effects, with a gap of this "
            f"size from one of {rivals} other causes, {simulated.get('confused')} were given this name, and "
            f"{simulated.get('passed')} if the library lacked the true cause{mostly}."
        )
    return sentences


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
            "Where both agree, the cause's equation is right. A free function has no memory and hardly shows lags or "
            "delays."
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
