"""Sections about the limits of a recording's inputs, the reliability of a name, and the next experiment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from fdi_torch.gap.verdict_words import explanation_words
from fdi_torch.report.chart import Chart, Line
from fdi_torch.report.html import folded, tag
from fdi_torch.report.material import Material
from fdi_torch.report.numbers import as_float, as_vector, axis, number, percent, shown_unit
from fdi_torch.report.section import Section, signals
from fdi_torch.report.style import MODEL

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
        unit, scale = shown_unit(str(units.get(name, "")), name)
        time, values = as_vector(channel["at"]), scale * as_vector(channel["value"])
        line = Line("command", np.append(time, end), np.append(values, values[-1:]), MODEL, steps=True)
        chart = Chart(name, "time, s", axis("command", unit), [line], clock="next")
        pictures.append(signals(f"gap_next_input_{k + 1}", chart))
    return Section("Next experiment", [_next_words(proposal), pictures])


def limits_section(material: Material) -> Section | None:
    """Effects that these inputs hide or confuse, and how often another cause would have got this name."""
    excitation = material.answer.get("excitation") or {}
    confusability = material.answer.get("impostors") or {}
    blocks: list[Any] = [*_confusability_words(confusability)]
    hidden = [explanation_words([cause]) for cause in excitation.get("hidden") or []]
    pairs = [" and ".join(explanation_words([c]) for c in p["between"]) for p in excitation.get("inseparable") or []]
    small = "Effects that these inputs do not show at their typical size"
    for title, items in ((small, hidden), ("Pairs of effects with the same signature under these inputs", pairs)):
        if items:
            listed = tag("ul", *(tag("li", item) for item in items[:MOST_LISTED]))
            blocks.append(folded(f"{title}: {len(items)}", listed))
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
