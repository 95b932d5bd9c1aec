"""Scores as a table in Markdown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

SHOWN = {
    "right": "right",
    "in_set": "truth in the answer set",
    "place": "right place",
    "named_wrong": "named and wrong",
    "closed_within": "`closed` within 3 points",
    "utility": "utility",
    "set_size": "explanations",
    "sec": "s a case",
}


def markdown(scores: Mapping[str, Any], name: str = "fdi") -> str:
    """A line a stratum: hits of cases and the 95 % interval in per cent; means with theirs; then the baselines."""
    strata = [s for s in scores[name] if s != "by_effect"]
    rows = [[s, *(in_words(scores[name][s].get(column)) for column in SHOWN)] for s in strata]
    others = [other for other in scores if other != name]
    beside = [[s, *(in_words(scores[other].get(s, {}).get("right")) for other in (name, *others))] for s in strata]
    effects = scores[name].get("by_effect", {})
    each = [[e, *(in_words(effects[e].get(column)) for column in ("right", "in_set", "named_wrong"))] for e in effects]
    return "\n\n".join(
        [
            _table(["kind", *SHOWN.values()], rows),
            "Right answers beside those of the baselines:",
            _table(["kind", name, *others], beside),
            "Cases with one cause, by effect; those without a name by the law that the rig follows:",
            _table(["effect", "right", "truth in the answer set", "named and wrong"], each),
        ]
    )


def in_words(score: Mapping[str, Any] | None) -> str:
    if not score:
        return ""
    low, high = score["ci95"]
    if "share" in score:
        return f"{score['hits']}/{score['of']} ({100 * low:.0f} .. {100 * high:.0f} %)"
    if low is None or low != low or score["of"] < 2:
        return f"{score['mean']:.3g}"
    return f"{score['mean']:.3g} ({low:.3g} .. {high:.3g})"


def _table(header: list[str], rows: list[list[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
