"""A gap diagnosis: where the gap lies, what causes it, how far it closes, and what would tell the rivals apart.

Beside the protocol's keys the answer may hold, SI:
`shape`: location, tables (EFFECT.VARIABLE -> at (K,), share (K,) of scale, scale);
`next_input`: separation, parted_after (s), input (duration, unit by channel, CHANNEL -> at (S,) in s, value (S,));
`remarks`: texts; `impostors`: numbers by name.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fdi_torch.report.html import pairs, table, tag
from fdi_torch.report.material import Material
from fdi_torch.report.numbers import axis, number, percent, shown_unit, with_error
from fdi_torch.report.panels import bar_panel, line_panel
from fdi_torch.report.section import Picture, Section
from fdi_torch.report.style import MARK, MODEL, SOFT

MOST_BARS = 10
LEAST_SHOWN = 1e-4  # of a probability
STAGES = {
    "nominal": "as believed",
    "recalibrated": "recalibrated",
    "augmented": "with the cause",
    "ceiling": "free-form",
    "noise_floor": "noise",
}


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
    names = [name for name, _ in ranked]
    figure = bar_panel("Where", "share of the gap, %", names, shares, texts, [name in guilty for name in names])
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
    standing = [_explanation(causes) for causes in answer.get("ambiguity_set", [])]
    if len(standing) > 1:
        blocks += ["These explanations stand at 95 %:", tag("ul", *(tag("li", words) for words in standing))]
    weighed = [item for item in answer.get("posterior", []) if _float(item.get("probability")) >= LEAST_SHOWN]
    posterior = weighed[:MOST_BARS]
    if posterior:
        names = [_weighed(item) for item in posterior]
        chances = [100.0 * float(item["probability"]) for item in posterior]
        texts = [f"{chance:.3g} %" for chance in chances]
        kept = [name in standing for name in names]
        figure = bar_panel("Explanations", "probability, %", names, chances, texts, kept)
        blocks.append([Picture("gap_posterior", figure, "Orange: together they hold 95 %.")])
    blocks += [tag("ul", *(tag("li", str(remark)) for remark in answer["remarks"]))] if answer.get("remarks") else []
    facts = [(name.replace("_", " "), _plain(value)) for name, value in (answer.get("impostors") or {}).items()]
    blocks += [pairs(facts)] if facts else []
    return Section("What causes it", blocks) if blocks else None


def closure_section(material: Material) -> Section | None:
    """Errors on data that no fit has seen."""
    closure = material.answer.get("closure") or {}
    stages = [name for name in STAGES if isinstance(closure.get(name), int | float)]
    if not stages:
        return None
    unit = str(closure.get("unit", ""))
    values = [float(closure[name]) for name in stages]
    texts = [f"{number(v, 3)} {unit}".rstrip() for v in values]
    names = [STAGES[name] for name in stages]
    label = axis("free-run root mean square error", unit)
    figure = bar_panel("Hold-out", label, names, values, texts, [name == "augmented" for name in stages])
    per_sensor = _sensor_rows(closure, stages)
    rows = [["all", *(number(v, 3) for v in values)], *per_sensor]
    blocks: list[Any] = [_closed(closure), [Picture("gap_closure", figure)]]
    blocks.append(table([f"sensor{', ' + unit if unit else ''}", *names], rows))
    return Section("How far it closes", blocks)


def shape_section(material: Material) -> Section | None:
    """The free-form discrepancy at the guilty place against its own variables."""
    shape = material.answer.get("shape")
    if not isinstance(shape, dict) or not shape.get("tables"):
        return None
    pictures = []
    for k, (name, curve) in enumerate(shape["tables"].items()):
        variable = str(name).rpartition(".")[2]
        unit, scale = shown_unit(_VARIABLE_UNITS.get(variable, "SI"))
        x, y = scale * _vector(curve["at"]), _float(curve.get("scale", 1.0)) * _vector(curve["share"])
        title = f"{shape.get('location', '')}: by {variable}"
        figure = line_panel(title, axis(variable, unit), "discrepancy, SI", [("discrepancy", x, y, MARK)])
        figure.axes[0].axhline(0.0, color=SOFT, lw=0.8)
        pictures.append(Picture(f"gap_shape_{k + 1}", figure))
    words = "What has to be added at this place so that the readings are met, whatever its cause."
    return Section("The discrepancy", [words, pictures])


def next_input_section(material: Material) -> Section | None:
    """The input that would part the rivals."""
    wanted = material.answer.get("next_input")
    if not isinstance(wanted, dict) or not isinstance(wanted.get("input"), dict):
        return None
    steps = {name: c for name, c in wanted["input"].items() if isinstance(c, dict) and "at" in c}
    units, end = wanted["input"].get("unit") or {}, _float(wanted["input"].get("duration"))
    pictures = []
    for k, (name, channel) in enumerate(steps.items()):
        unit, scale = shown_unit(str(units.get(name, "")))
        time, values = _vector(channel["at"]), scale * _vector(channel["value"])
        line = (name, np.append(time, end), np.append(values, values[-1:]), MODEL)
        figure = line_panel(name, "time, s", axis("command", unit), [line])
        figure.axes[0].lines[0].set_drawstyle("steps-post")
        pictures.append(Picture(f"gap_next_input_{k + 1}", figure))
    words = ["The input within the limits of pumps and levels that separates the best two explanations most."]
    when = wanted.get("parted_after")
    words += [f"They are expected to part after {number(float(when))} s."] if isinstance(when, int | float) else []
    return Section("What to run next", [" ".join(words), pictures])


# SI units of the variables that a free-form discrepancy may depend on.
_VARIABLE_UNITS = {"level": "m", "head": "m", "difference": "m", "time": "s", "period": "s"}


def _chance(place: Mapping[str, Any]) -> str:
    p = place.get("p_value")
    return f"  (p {number(float(p), 2)})" if isinstance(p, int | float) else ""


def _cause_rows(cause: Mapping[str, Any]) -> list[list[str]]:
    effect, location = str(cause["effect"]).replace("_", " "), str(cause["location"])
    rows = []
    for name, amount in (cause.get("parameters") or {}).items():
        unit, scale = shown_unit(str(amount.get("unit", "")))
        value, std = scale * _float(amount.get("value")), scale * _float(amount.get("std"))
        rows.append([effect, location, str(name).replace("_", " "), with_error(value, std), unit])
    return rows or [[effect, location, "", "", ""]]


def _twins(causes: Sequence[Mapping[str, Any]]) -> list[str]:
    """Causes that are one thing under two names."""
    told = [(c, _explanation(c["same_as"])) for c in causes if c.get("same_as")]
    return [f"{_explanation([cause])} is the same as {twin}." for cause, twin in told]


def _explanation(causes: Sequence[Mapping[str, Any]]) -> str:
    return " + ".join(f"{c['effect']} at {c['location']}".replace("_", " ") for c in causes) or "no gap"


def _weighed(item: Mapping[str, Any]) -> str:
    return f"unknown at {item['unknown_at']}" if item.get("unknown_at") else _explanation(item["causes"])


def _closed(closure: Mapping[str, Any]) -> str:
    share, interval = closure.get("closed"), list(closure.get("closed_ci95") or [])
    if not isinstance(share, int | float):
        return "How much of the gap closes is undefined: it is too small against its own standard error."
    between = f" (95 % interval {percent(interval[0])} to {percent(interval[1])})" if _is_interval(interval) else ""
    return f"{percent(share)} of the gap is closed on data not used for fitting{between}."


def _is_interval(interval: Any) -> bool:
    return len(interval) == 2 and all(isinstance(end, int | float) for end in interval)


def _sensor_rows(closure: Mapping[str, Any], stages: Sequence[str]) -> list[list[str]]:
    """per_sensor: sensor -> stage -> error, or stage -> sensor -> error."""
    told = closure.get("per_sensor") or {}
    if told and set(told) <= set(STAGES):
        sensors = dict.fromkeys(sensor for errors in told.values() for sensor in errors)
        told = {sensor: {stage: told.get(stage, {}).get(sensor) for stage in stages} for sensor in sensors}
    return [[str(s), *(number(_float(errors.get(stage)), 3) for stage in stages)] for s, errors in told.items()]


def _vector(values: Any) -> np.ndarray:
    return np.array([_float(value) for value in values])


def _float(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else float("nan")


def _plain(value: Any) -> str:
    return number(float(value)) if isinstance(value, float) else str(value)
