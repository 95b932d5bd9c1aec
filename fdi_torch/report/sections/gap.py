"""Sections about a gap diagnosis: location and causes of the gap. The answer is JSON from a log, hence untrusted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure

from fdi_torch.amounts import probability_words
from fdi_torch.gap.verdict_words import FORMAT_1, apart_from_rounding, causes_of, explanation_words, rounding_words
from fdi_torch.report.gap_tables import cause_table, flow_table, has_causes
from fdi_torch.report.html import bullets, shown, table
from fdi_torch.report.material import Material
from fdi_torch.report.numbers import as_float, number, percent
from fdi_torch.report.section import Picture, Section
from fdi_torch.report.style import BAR_NAME, bar_panel

MOST_BARS = 10
LEAST_SHOWN = 1e-3  # of a probability that gets a bar
CREDIBLE_LEVEL = 0.95  # probability of the plausible explanations together


def where_section(material: Material) -> Section | None:
    """Probability of a discrepancy at each component, whatever its law; nothing without a gap."""
    ranked = sorted(material.where.items(), key=lambda item: -float(item[1]["share"]))
    if not ranked or not has_causes(material.answer):
        return None
    shown = [item for item in ranked if float(item[1]["share"]) >= LEAST_SHOWN] or ranked[:3]
    caption = f"Below {percent(LEAST_SHOWN)}: {len(ranked) - len(shown)} other places." if ranked[len(shown) :] else ""
    ranked = shown[:MOST_BARS]
    shares = [100.0 * float(place["share"]) for _, place in ranked]
    texts = []
    for _, place in ranked:
        p = place.get("p_value")
        chance = f"  (p {number(float(p), 2)})" if isinstance(p, int | float) else ""
        texts.append(probability_words(float(place["share"])) + chance)
    likeliest = [cause for item in material.answer.get("posterior", [])[:1] for cause in causes_of(item)]
    guilty = {str(c["location"]) for c in apart_from_rounding([*material.answer.get("causes", []), *likeliest])}
    names = [name for name, _ in ranked]
    meaning = material.meaning_of_shares
    label = "share of the gap, %" if material.answer.get("format") == FORMAT_1 else "probability, %"
    figure = _bars(label, names, shares, texts, [name in guilty for name in names])
    words = f"{meaning[:1].upper()}{meaning[1:]}. Orange: causes of the likeliest explanation."
    return Section("Where the gap lies", [words, [Picture("gap_where", figure, caption)]], lead=True)


def causes_section(material: Material) -> Section | None:
    """Parameters of the best explanation, and all explanations with their probabilities."""
    answer = material.answer
    if not answer:
        return None
    causes = cause_table(answer)
    blocks: list[Any] = [table(causes.header, causes.cells(), causes.left)] if len(causes) else []
    blocks += [words] if (words := rounding_words(answer.get("causes") or [])) else []
    certain = apart_from_rounding(answer.get("certain") or [])
    if certain and answer.get("verdict") != "named":
        blocks.append(f"With 95 % probability, whichever explanation is true: {explanation_words(certain)}.")
    bars = posterior_bars(answer)
    plausible = [explanation_words(causes) for causes in answer.get("ambiguity_set") or _content(answer)]
    if len(plausible) > 1 and (not bars or max(map(len, plausible)) > BAR_NAME):
        blocks += ["Explanations with 95 % of the probability together:", *bullets(plausible)]
    blocks += bars
    blocks += bullets(answer.get("remarks") or ())
    return Section("What causes it", blocks, lead=True) if blocks else None


def disturbances_section(material: Material) -> Section | None:
    """Random flows into the tanks that matter, estimated together with the likeliest explanation."""
    flows = flow_table(material.answer, material.plant)
    words = "They are estimated together with the likeliest explanation: waves, pulsation, splashing."
    return Section("Random flows", [shown(flows), words]) if len(flows) else None


def _content(answer: Mapping[str, Any]) -> list[list[Mapping[str, Any]]]:
    """The fewest explanations with 95 % of the probability together."""
    total, chosen = 0.0, []
    for item in answer.get("posterior", []):
        if total >= CREDIBLE_LEVEL:
            break
        total += as_float(item.get("probability"))
        chosen.append(causes_of(item))
    return chosen


def posterior_bars(answer: Mapping[str, Any]) -> list[list[Picture]]:
    """Bars of the explanations' probabilities, and of that of unexamined ones."""
    weighted = [item for item in answer.get("posterior", []) if as_float(item.get("probability")) >= LEAST_SHOWN]
    explanations = [causes_of(item) for item in weighted[:MOST_BARS]]
    first = apart_from_rounding(explanations[0]) if len(explanations) > 1 else []
    shared = [cause for cause in first if all(cause in each for each in explanations)]
    names = [_beside(shared, each) for each in explanations]
    chances = [as_float(item["probability"]) for item in weighted[:MOST_BARS]]
    within = [k < len(_content(answer)) for k in range(len(chances))]
    if as_float(answer.get("unexamined")) >= LEAST_SHOWN:
        names, chances, within = [*names, "not examined"], [*chances, as_float(answer["unexamined"])], [*within, False]
    if not names:
        return []
    percents = [100.0 * chance for chance in chances]
    texts = [probability_words(0.01 * percent) for percent in percents]
    figure = _bars("probability, %", names, percents, texts, within)
    caption = f"All contain {explanation_words(shared)}. " if shared else ""
    return [
        [Picture("gap_posterior", figure, f"{caption}Orange: together they have at least 95 % of the probability.")]
    ]


def _beside(shared: Sequence[Mapping[str, Any]], causes: Sequence[Mapping[str, Any]]) -> str:
    """The causes that not all explanations contain, as text beside a bar; the whole list would be too long for it."""
    others = [cause for cause in apart_from_rounding(causes) if cause not in shared]
    return explanation_words(others) if others or not shared else "nothing else"


def _bars(label: str, *bars: Any) -> Figure:
    """Bars without ticks beyond 100 %: that part of the axis only makes room for the numbers beside the bars."""
    figure = bar_panel("", label, *bars)
    axes = figure.axes[0]
    axes.set_xticks([tick for tick in axes.get_xticks() if 0.0 <= tick <= 100.0])
    return figure
