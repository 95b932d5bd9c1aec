"""Scores of diagnoses against the key: detection, name, location, answer set, confident errors, closure, utility."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from fdi_torch.blind.conditions import HELD_OUT
from fdi_torch.blind.kinds import KINDS
from fdi_torch.blind.places import Cause, canonical, effect_places
from fdi_torch.blind.sizes import size_errors
from fdi_torch.blind.statistics import mean_interval, median_interval, share_of
from fdi_torch.plant.description import OUTSIDE, PlantDescription
from fdi_torch.quantities import unit_factor

Answer = Mapping[str, Any]
Row = dict[str, Any]
SHARES = (
    "right",
    "place",
    "in_set",
    "cause_beside",
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
    """DXC'09 utility of an answered set of causes w for the true set v among f possible ones (Feldman et al., 2010).

    1 - n (N + 1) / (f (n + 1)) - m (M + 1) / (f (m + 1)), n = |w - v|, N = |w|, m = |v - w|, M = f - N.
    """
    w, v = set(answer), set(truth)
    n, m = len(w - v), len(v - w)
    return 1 - n * (len(w) + 1) / (pairs * (n + 1)) - m * (pairs - len(w) + 1) / (pairs * (m + 1))


def expected_utility(answer: Answer, sets: Sequence[list[Cause]], truth: list[Cause], plant: PlantDescription) -> float:
    """Utility averaged over the posterior; without one, over the members of the answer set with equal weights."""
    stated = [(_causes(x["causes"], plant), float(x["probability"])) for x in answer.get("posterior") or []]
    post = stated or [(s, 1.0) for s in sets or [[]]]
    weight, pairs = sum(w for _, w in post) or 1.0, len(effect_places(plant))
    return sum(w * utility(_with_names(s), truth, pairs) for s, w in post) / weight


def _with_names(causes: Sequence[Cause]) -> list[Cause]:
    """The causes without unknown ones, which are not effects of the library."""
    return [cause for cause in causes if cause[0] != "unknown"]


def judge(truth: Mapping[str, Any], answer: Answer, plant: PlantDescription) -> Row:
    """One row of scores. truth: a line of the key, with kind and causes."""
    kind, true = truth["kind"], _causes(truth["causes"], plant)
    causes = _causes(answer.get("causes"), plant)
    sets = [_causes(s, plant) for s in answer.get("ambiguity_set") or []] or ([causes] if causes else [])
    verdict, is_left_out = answer.get("verdict"), kind == "left_out"
    row: Row = {
        "kind": kind,
        "truth": true,
        "effect": truth["causes"][0].get("really", true[0][0]) if true else "none",
        "law": next((c["really"] for c in truth["causes"] if "really" in c), None),
        "verdict": verdict,
        "causes": causes,
        "set_size": len(sets),
        "crash": verdict == "crash",
        **_stated(kind, true, answer, plant),
        "utility": expected_utility(answer, sets, [] if is_left_out else _with_names(true), plant),
    }
    if not true:
        alarm = verdict != "no_gap"
        return row | {"right": not alarm, "false_alarm": alarm, "named_wrong": verdict == "named"}
    row |= {"detected": verdict not in ("no_gap", "crash")} | judge_closure(truth, answer, plant)
    outside_library = [("unknown", true[0][1])] if is_left_out else [cause for cause in true if cause[0] == "unknown"]
    if outside_library:
        where = [w["location"] for w in answer.get("where") or []]
        named = [] if is_left_out else _with_names(true)
        return row | _judge_unknown(outside_library[0], named, causes, sets, verdict, where)
    row |= {"z": size_errors(truth, answer.get("causes") or (), plant)} if verdict in ("named", "ambiguous") else {}
    if kind == "messy":
        full = true[0]  # the faint ones need not be named
        row |= {"right": full in causes, "place": any(place == full[1] for _, place in causes)}
        return row | {"named_wrong": verdict == "named" and not row["right"]}
    of_outlets = [[("leak", p.source)] for p in plant.pipes if p.target == OUTSIDE]
    tolerated = verdict == "no_gap" and true in of_outlets and not KINDS[kind].shows
    row |= _judge_named(true, causes, sets, verdict, tolerated)
    return row | ({"right": row["in_set"]} if kind == "dsingle" else {})


def _stated(kind: str, true: list[Cause], answer: Answer, plant: PlantDescription) -> Row:
    """The stated probability of the best explanation, and whether it is the true one."""
    best = max(answer.get("posterior") or [], key=lambda x: float(x["probability"]), default=None)
    if best is None:
        return {}
    causes = _causes(best["causes"], plant)
    expected = [("unknown", true[0][1])] if kind == "left_out" else true
    if kind == "messy":
        right = true[0] in causes and _with_names(causes) == causes
    else:
        right = sorted(causes) == sorted(expected)
    return {"stated": float(best["probability"]), "stated_right": right}


def _judge_unknown(
    unknown: Cause, named: list[Cause], causes: list[Cause], sets: list[list[Cause]], verdict: Any, where: list[str]
) -> Row:
    """Scores for a law outside the library. named: true causes elsewhere, all of which `cause_beside` requires."""
    at_place = where[:1] == [unknown[1]] or unknown in causes
    row = {"right": verdict == "unknown" and at_place, "place": at_place, "named_wrong": verdict == "named"}
    if not named:
        return row
    whole = sorted([*named, unknown])
    return row | {
        "cause_beside": row["right"] and _with_names(causes) == named,
        "in_set": any(sorted(s) == whole for s in sets),
    }


def _judge_named(true: list[Cause], causes: list[Cause], sets: list[list[Cause]], verdict: Any, tolerated: bool) -> Row:
    """tolerated: no gap was reported, and the cause is an outlet's deviation that may lie within its tolerance."""
    named = sorted(causes) == sorted(true)
    return {
        "right": (named and verdict in ("named", "ambiguous")) or tolerated,
        "in_set": any(sorted(s) == sorted(true) for s in sets) or tolerated,
        "place": sorted(p for _, p in causes) == sorted(p for _, p in true) or tolerated,
        "named_wrong": verdict == "named" and not named,
        "missed": verdict == "no_gap",
    }


def judge_closure(truth: Mapping[str, Any], answer: Answer, plant: PlantDescription) -> Row:
    """Error of `closed` relative to 1 - (a^2 - f^2)/(r^2 - f^2) with the true noise f of the hold-out.

    Defined if the gap r^2 - f^2 after recalibration is larger than five standard errors. The answer is in the unit of
    the first sensor, the key in metres of level.
    """
    closure = answer.get("closure") or {}
    if truth.get("disturbance"):  # the error floor is then larger than the sensors' noise
        return {}
    if not truth.get("noise_rms_m") or any(closure.get(k) is None for k in ("recalibrated", "augmented")):
        return {}
    sensor = plant.sensors[0]
    metres = unit_factor(closure.get("unit", "cm"), sensor.unit) / sensor.gain
    floor = truth["noise_rms_m"]["holdout"]
    square = math.fsum(f * f for f in floor) / len(floor)
    residual, gap = ((closure[k] * metres) ** 2 - square for k in ("augmented", "recalibrated"))
    error = square * math.sqrt(2 / (HELD_OUT * len(floor)) * truth.get("repeats", 1.0))
    if gap < 5 * error:
        return {}
    if closure.get("closed") is None:
        return {"closed_within": False}
    off = abs(closure["closed"] - (1 - residual / gap))
    return {"closed_error": off, "closed_within": off <= 0.03}


def _causes(listed: Any, plant: PlantDescription) -> list[Cause]:
    return [canonical((c["effect"], c["location"]), plant) for c in listed or []]


def summary(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """Scores by stratum and over all: shares with exact 95 % intervals, means with normal ones."""
    strata = {kind: own for kind in KINDS if (own := [r for r in rows if r["kind"] == kind])}
    return {name: _stratum(of) for name, of in (*strata.items(), ("all", list(rows)))}


def by_effect(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """Scores of each effect over the cases with this single cause; laws outside the library under their own name."""
    lone = [r for r in rows if len(r["truth"]) == 1]
    return {e: _stratum([r for r in lone if r["effect"] == e]) for e in sorted({r["effect"] for r in lone})}


def _stratum(rows: Sequence[Row]) -> dict[str, Any]:
    out: dict[str, Any] = {"cases": len(rows)}
    for name in SHARES:
        hits = [bool(r[name]) for r in rows if name in r]
        if hits:
            out[name] = share_of(sum(hits), len(hits))
    for names, kind, interval in ((MEANS, "mean", mean_interval), (MEDIANS, "median", median_interval)):
        for name in names:
            values = [float(r[name]) for r in rows if r.get(name) is not None]
            if values:
                middle, *ends = interval(values)
                key = name if kind == "mean" else f"median_{name}"
                out[key] = {"of": len(values), kind: middle, "ci95": ends}
    return out
