"""A gap diagnosis: where the gap lies, and what causes it. The answer is JSON from a log, and so untrusted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure

from fdi_torch.report.html import table, tag
from fdi_torch.report.loose import as_float
from fdi_torch.report.material import Material
from fdi_torch.report.numbers import number, shown_unit, with_error
from fdi_torch.report.panels import bar_panel
from fdi_torch.report.section import Picture, Section

MOST_BARS = 10
LEAST_SHOWN = 1e-4  # of a probability


def where_section(material: Material) -> Section | None:
    """How much of the gap each component alone can close, library-free."""
    where = {str(m["location"]): m for m in material.of("/gap/where")}
    where |= {str(place["location"]): place for place in material.answer.get("where", [])}
    ranked = sorted(where.items(), key=lambda item: -float(item[1]["share"]))[:MOST_BARS]
    if not ranked:
        return None
    shares = [100.0 * float(place["share"]) for _, place in ranked]
    texts = [f"{share:.3g} %{_chance(place)}" for share, (_, place) in zip(shares, ranked, strict=True)]
    guilty = {str(cause["location"]) for cause in material.answer.get("causes", [])}
    guilty |= {str(e["unknown_at"]) for e in material.answer.get("posterior", [])[:1] if e.get("unknown_at")}
    names = [name for name, _ in ranked]
    figure = bar_panel("Where", "share of the gap, %", names, shares, texts, [name in guilty for name in names])
    _up_to_all(figure)
    words = "What a free-form discrepancy at one component alone can close. Orange: where the causes are."
    return Section("Where the gap lies", [words, [Picture("gap_where", figure)]])


def causes_section(material: Material) -> Section | None:
    """The best explanation with its parameters, and what else stands."""
    answer = material.answer
    if not answer:
        return None
    header = ("effect", "at", "parameter", "value", "unit")
    rows = [row for cause in answer.get("causes", []) for row in _cause_rows(cause)]
    blocks: list[Any] = [table(header, rows, left=3)] if rows else []
    blocks += _twins(answer.get("causes", []))
    standing = [explanation_words(causes) for causes in answer.get("ambiguity_set", [])]
    if len(standing) > 1:
        blocks += ["These explanations stand at 95 %:", tag("ul", *(tag("li", words) for words in standing))]
    weighed = [item for item in answer.get("posterior", []) if as_float(item.get("probability")) >= LEAST_SHOWN]
    posterior = weighed[:MOST_BARS]
    if posterior:
        names = [_weighed(item) for item in posterior]
        chances = [100.0 * float(item["probability"]) for item in posterior]
        texts = [f"{chance:.3g} %" for chance in chances]
        kept = [name in standing or bool(item.get("unknown_at")) for name, item in zip(names, posterior, strict=True)]
        figure = bar_panel("Explanations", "probability, %", names, chances, texts, kept)
        _up_to_all(figure)
        blocks.append([Picture("gap_posterior", figure, "Orange: together they hold 95 %." if standing else "")])
    blocks += [tag("ul", *(tag("li", str(remark)) for remark in answer["remarks"]))] if answer.get("remarks") else []
    return Section("What causes it", blocks) if blocks else None


def _up_to_all(figure: Figure) -> None:
    """No ticks beyond 100 %, where only the numbers at the ends of the bars stand."""
    axes = figure.axes[0]
    axes.set_xticks([tick for tick in axes.get_xticks() if 0.0 <= tick <= 100.0])


def _chance(place: Mapping[str, Any]) -> str:
    p = place.get("p_value")
    return f"  (p {number(float(p), 2)})" if isinstance(p, int | float) else ""


def _cause_rows(cause: Mapping[str, Any]) -> list[list[str]]:
    effect, location = str(cause["effect"]).replace("_", " "), str(cause["location"])
    rows = []
    for name, amount in (cause.get("parameters") or {}).items():
        unit, scale = shown_unit(str(amount.get("unit", "")))
        value, std = scale * as_float(amount.get("value")), scale * as_float(amount.get("std"))
        rows.append([effect, location, str(name).replace("_", " "), with_error(value, std), unit])
    return rows or [[effect, location, "", "", ""]]


def _twins(causes: Sequence[Mapping[str, Any]]) -> list[str]:
    """Causes that are one thing under two names."""
    told = [(c, explanation_words(c["same_as"])) for c in causes if c.get("same_as")]
    return [f"{explanation_words([cause])} is the same as {twin}." for cause, twin in told]


def explanation_words(causes: Sequence[Mapping[str, Any]]) -> str:
    return " + ".join(f"{c['effect']} at {c['location']}".replace("_", " ") for c in causes) or "no gap"


def _weighed(item: Mapping[str, Any]) -> str:
    return f"unknown at {item['unknown_at']}" if item.get("unknown_at") else explanation_words(item["causes"])
