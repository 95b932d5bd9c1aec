"""Scores diagnoses against the opened key: detection, name, place, answer set, confident errors, closure, utility."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from fdi_torch.gap.challenge.conditions import HELD_OUT
from fdi_torch.gap.challenge.intervals import clopper_pearson, mean_interval, median_interval
from fdi_torch.gap.challenge.kinds import KINDS
from fdi_torch.gap.challenge.places import Cause, canonical, effect_places
from fdi_torch.parameters import unit_factor
from fdi_torch.plant.description import OUTSIDE, PlantDescription

Answer = Mapping[str, Any]
Row = dict[str, Any]
SHARES = (
    "right",
    "place",
    "in_set",
    "named_wrong",
    "detected",
    "missed",
    "false_alarm",
    "closed_within",
    "crash",
)
MEANS = ("utility", "set_size", "sec")
MEDIANS = ("closed_error", "sec")


def utility(answer: Collection[Cause], truth: Collection[Cause], pairs: int) -> float:
    """DXC'09 utility of a set of causes w for the truth v of f pairs (Feldman et al., 2010).

    1 - n (N + 1) / (f (n + 1)) - m (M + 1) / (f (m + 1)), n = |w - v|, N = |w|, m = |v - w|, M = f - N.
    """
    w, v = set(answer), set(truth)
    n, m = len(w - v), len(v - w)
    return 1 - n * (len(w) + 1) / (pairs * (n + 1)) - m * (pairs - len(w) + 1) / (pairs * (m + 1))


def expected_utility(answer: Answer, sets: Sequence[list[Cause]], truth: list[Cause], plant: PlantDescription) -> float:
    """Utility weighted by the posterior; where there is none, each member of the answer set counts the same."""
    post = [(_causes(x["causes"], plant), float(x["probability"])) for x in answer.get("posterior") or []]
    post = post or [(s, 1.0) for s in sets or [[]]]
    weight = sum(w for _, w in post) or 1.0
    return sum(w * utility(s, truth, len(effect_places(plant))) for s, w in post) / weight


def judge(truth: Mapping[str, Any], answer: Answer, plant: PlantDescription) -> Row:
    """One row of scores. truth: a line of the key, with its kind and causes."""
    kind, true = truth["kind"], _causes(truth["causes"], plant)
    causes = _causes(answer.get("causes"), plant)
    sets = [_causes(s, plant) for s in answer.get("ambiguity_set") or []] or ([causes] if causes else [])
    verdict, nameless = answer.get("verdict"), kind in ("unknown", "left_out")
    row: Row = {
        "kind": kind,
        "truth": true,
        "effect": truth["causes"][0].get("really", true[0][0]) if true else "none",
        "verdict": verdict,
        "causes": causes,
        "set_size": len(sets),
        "crash": verdict == "crash",
        **_stated(kind, true, answer, plant),
        "utility": expected_utility(answer, sets, [] if nameless else true, plant),
    }
    if kind == "null":
        alarm = verdict != "no_gap"
        return row | {"right": not alarm, "false_alarm": alarm, "named_wrong": verdict == "named"}
    row |= {"detected": verdict not in ("no_gap", "crash")} | judge_closure(truth, answer, plant)
    if nameless:
        return row | _judge_nameless(true, verdict, [w["location"] for w in answer.get("where") or []])
    if kind == "messy":
        return row | _judge_messy(true[0], causes, verdict)
    tolerated = verdict == "no_gap" and true in [[("leak", p.source)] for p in plant.pipes if p.target == OUTSIDE]
    return row | _judge_named(true, causes, sets, verdict, tolerated)


def _stated(kind: str, true: list[Cause], answer: Answer, plant: PlantDescription) -> Row:
    """The probability that the best explanation was given, and whether it is the true one."""
    best = max(answer.get("posterior") or [], key=lambda x: float(x["probability"]), default=None)
    if best is None:
        return {}
    causes, unknown_at = _causes(best["causes"], plant), best.get("unknown_at")
    if kind in ("unknown", "left_out"):
        right = unknown_at == true[0][1]
    elif kind == "messy":
        right = not unknown_at and true[0] in causes
    else:
        right = not unknown_at and sorted(causes) == sorted(true)
    return {"stated": float(best["probability"]), "stated_right": right}


def _judge_nameless(true: list[Cause], verdict: Any, where: list[str]) -> Row:
    at_place = where[:1] == [true[0][1]]
    return {"right": verdict == "unknown" and at_place, "place": at_place, "named_wrong": verdict == "named"}


def _judge_messy(full: Cause, causes: list[Cause], verdict: Any) -> Row:
    """The full effect is to be named; the faint ones may be."""
    return {
        "right": full in causes,
        "place": any(place == full[1] for _, place in causes),
        "named_wrong": verdict == "named" and full not in causes,
    }


def _judge_named(true: list[Cause], causes: list[Cause], sets: list[list[Cause]], verdict: Any, tolerated: bool) -> Row:
    """tolerated: the cause is a change of an outlet that may lie within its tolerance, and no gap was reported."""
    named = sorted(causes) == sorted(true)
    return {
        "right": (named and verdict in ("named", "ambiguous")) or tolerated,
        "in_set": any(sorted(s) == sorted(true) for s in sets) or tolerated,
        "place": sorted(p for _, p in causes) == sorted(p for _, p in true) or tolerated,
        "named_wrong": verdict == "named" and not named,
        "missed": verdict == "no_gap",
    }


def judge_closure(truth: Mapping[str, Any], answer: Answer, plant: PlantDescription) -> Row:
    """How far `closed` is from 1 - (a^2 - f^2)/(r^2 - f^2) with the true noise f of the hold-out.

    Defined where the gap r^2 - f^2 left by recalibration is over five of its standard errors. The answer is in the
    unit of the first sensor, the key in metres of level.
    """
    closure = answer.get("closure") or {}
    if not truth.get("noise_rms_m") or any(closure.get(k) is None for k in ("recalibrated", "augmented")):
        return {}
    sensor = plant.sensors[0]
    metres = unit_factor(closure.get("unit", "cm"), sensor.unit) / sensor.gain
    floor = truth["noise_rms_m"]["holdout"]
    square = math.fsum(f * f for f in floor) / len(floor)
    left, gap = ((closure[k] * metres) ** 2 - square for k in ("augmented", "recalibrated"))
    error = square * math.sqrt(2 / (HELD_OUT * len(floor)) * truth.get("repeats", 1.0))
    if gap < 5 * error:
        return {}
    if closure.get("closed") is None:
        return {"closed_within": False}
    off = abs(closure["closed"] - (1 - left / gap))
    return {"closed_error": off, "closed_within": off <= 0.03}


def _causes(listed: Any, plant: PlantDescription) -> list[Cause]:
    return [canonical((c["effect"], c["location"]), plant) for c in listed or []]


def summary(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """Scores by stratum and over all: shares with exact 95 % intervals, means with normal ones."""
    strata = {kind: own for kind in KINDS if (own := [r for r in rows if r["kind"] == kind])}
    return {name: _stratum(of) for name, of in (*strata.items(), ("all", list(rows)))}


def by_effect(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """The same for each effect that is the only cause of its case; those without a name go by their law."""
    lone = [r for r in rows if len(r["truth"]) == 1]
    return {e: _stratum([r for r in lone if r["effect"] == e]) for e in sorted({r["effect"] for r in lone})}


def _stratum(rows: Sequence[Row]) -> dict[str, Any]:
    out: dict[str, Any] = {"cases": len(rows)}
    for name in SHARES:
        hits = [bool(r[name]) for r in rows if name in r]
        if hits:
            low, high = clopper_pearson(sum(hits), len(hits))
            out[name] = {"of": len(hits), "hits": sum(hits), "share": sum(hits) / len(hits), "ci95": [low, high]}
    for name in MEANS:
        values = [float(r[name]) for r in rows if r.get(name) is not None]
        if values:
            mean, low, high = mean_interval(values)
            out[name] = {"of": len(values), "mean": mean, "ci95": [low, high]}
    for name in MEDIANS:
        values = [float(r[name]) for r in rows if r.get(name) is not None]
        if values:
            median, low, high = median_interval(values)
            out[f"median_{name}"] = {"of": len(values), "median": median, "ci95": [low, high]}
    return out
