"""Scored answers as rows, of one benchmark or several, the scores of rows that belong together, and their tables for
terminal, report page and Markdown.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from fdi_torch.blind.cases import answers, lines_of, manifest, open_key, read_plant
from fdi_torch.blind.score import Row, by_effect, judge, summary
from fdi_torch.blind.sizes import sizes
from fdi_torch.blind.statistics import share_of
from fdi_torch.disk import write_text
from fdi_torch.plant.description import PlantDescription
from fdi_torch.tables import Table

ROWS = "rows.jsonl"
EDGES = (0.0, 0.5, 0.9, 0.99, 1.0)
"""Edges of the bins of the stated probability of the best explanation."""
_SAME = ("rig", "seed", "kind", "index", "by")

Scores = dict[str, Any]
"""strata: {kind or 'all': scores}; by_effect: {effect: scores}; sizes: {effect: z-scores}; calibration: bins."""
Tables = dict[str, dict[str, Scores]]
"""{rig, or rig with effects left out: {name of the diagnosis: scores}}."""


def judged(names: Sequence[str], cases: int, out: Path) -> list[Row]:
    """Open the key, score all answers, and write the rows to the folder."""
    truths, spec = open_key(out), json.loads((out / "spec.json").read_text())
    plants = {case: read_plant(out, line) for case, line in list(manifest(out).items())[:cases]}
    rows = []
    for name in names:
        about = {"by": name, "rig": spec["rig"], "seed": spec["seed"]}
        for line in lines_of(answers(out, name)):
            if line["case"] in plants:
                rows.append(about | _row(line, truths[line["case"]], plants[line["case"]]))
    write_rows(out, rows)
    return rows


def _row(line: Mapping[str, Any], truth: Mapping[str, Any], plant: PlantDescription) -> Row:
    about = {key: truth.get(key) for key in ("case", "index", "signal", "colour")}
    about |= {"sec": line["sec"], "code": line.get("code", ""), "gap_rms_m": truth["gap_rms_m"]["recording"]}
    if truth.get("disturbance"):
        about["disturbance"] = truth["disturbance"]["kind"]
        about["moves_levels_by_noise"] = truth["disturbance"]["moves_levels_by_noise"]
    row = about | judge(truth, line["answer"], plant)
    return {key: float(f"{value:.6g}") if isinstance(value, float) else value for key, value in row.items()}


def write_rows(out: Path, rows: Iterable[Row]) -> None:
    write_text(out / ROWS, "".join(json.dumps(row) + "\n" for row in rows))


def joined(folders: Iterable[Path]) -> list[Row]:
    """The rows of several folders. A case that is in several folders counts once, with its last answer.

    Raises ValueError for a folder without scored answers.
    """
    merged: dict[tuple[Any, ...], Row] = {}
    for folder in folders:
        rows = lines_of(folder / ROWS)
        if not rows:
            raise ValueError(f"{folder}: expected a benchmark's folder, got one without answers; name an earlier --out")
        merged |= {tuple(row[key] for key in _SAME): row for row in rows}
    return list(merged.values())


def tables(rows: Iterable[Row]) -> Tables:
    """Scores by rig and diagnosis; cases with an effect left out of the library are a separate group."""
    groups: dict[str, dict[str, list[Row]]] = {}
    for row in rows:
        groups.setdefault(group_of(row), {}).setdefault(row["by"], []).append(row)
    return {group: {name: scores_of(answers_of) for name, answers_of in by.items()} for group, by in groups.items()}


def group_of(row: Row) -> str:
    return f"{row['rig']}, effect left out" if row["kind"] == "left_out" else str(row["rig"])


def scores_of(rows: Sequence[Row]) -> Scores:
    return {
        "strata": summary(rows),
        "by_effect": by_effect(rows),
        "sizes": sizes(rows),
        "calibration": reliability(rows),
    }


def reliability(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Calibration: how often the best explanation is true, in bins of its stated probability.

    Each non-empty bin has its limits, mean probability, hits, number of cases, and exact 95 % interval.
    """
    stated = [(float(r["stated"]), bool(r["stated_right"])) for r in rows if r.get("stated") is not None]
    bins = []
    for low, high in pairwise(EDGES):
        inside = [(p, right) for p, right in stated if low < p <= high]
        if inside:
            hits = sum(right for _, right in inside)
            mean = math.fsum(p for p, _ in inside) / len(inside)
            bins.append({"low": low, "high": high, "stated": mean} | share_of(hits, len(inside)))
    return bins


OWN = "fdi"
NAMES = {
    "right": "right",
    "in_set": "truth in the answer set",
    "place": "right place",
    "named_wrong": "named and wrong",
}
SIZES = {
    "false_alarm": "false alarm",
    "detected": "detected",
    "set_size": "explanations",
    "utility": "utility",
    "cause_beside": "cause named beside an unknown",
}
CLOSURE = {
    "closed_within": "closed within 3 points",
    "median_closed_error": "median error of closed",
    "sec": "s a case",
    "median_sec": "median s a case",
}
MOST_MISSES = 200


def sheets(by: Mapping[str, Scores]) -> list[Table]:
    """All score tables of one rig, from the scores by diagnosis."""
    own, others = by[OWN], [name for name in by if name != OWN]
    strata = own["strata"]
    beside = [[s, *(in_words(by[n]["strata"].get(s, {}).get("right")) for n in (OWN, *others))] for s in strata]
    over_all = [
        [name, *(in_words(by[name]["strata"]["all"].get(c)) for c in (*NAMES, "utility"))] for name in (OWN, *others)
    ]
    bins = [[f"{b['low']:g} to {b['high']:g}", f"{b['stated']:.3f}", in_words(b)] for b in own["calibration"]]
    tables = {
        "Names and places, by kind": (("kind", *NAMES.values()), _rows(strata, NAMES)),
        "Alarm, size of the answer set and utility, by kind": (("kind", *SIZES.values()), _rows(strata, SIZES)),
        "Closure and time, by kind": (("kind", *CLOSURE.values()), _rows(strata, CLOSURE)),
        "Right answers, and those of the baselines": (("kind", OWN, *others), beside),
        "All kinds together, and the baselines": (("", *NAMES.values(), "utility"), over_all),
        "Calibration: how often the best explanation is true, by its stated probability": (
            ("stated probability", "mean", "is true"),
            bins,
        ),
        "Sizes of named causes, by effect: z against the truth": (
            ("effect", "root mean square of z", "within 1.96 standard errors"),
            _rows(own["sizes"], ("rms", "within")),
        ),
        "Cases with one cause, by effect; laws outside the library by their own name": (
            ("effect", *NAMES.values()),
            _rows(own["by_effect"], NAMES),
        ),
    }
    return [Table(header, rows, title) for title, (header, rows) in tables.items() if rows]


def misses(rows: Iterable[Row]) -> Table:
    """Wrong answers of our diagnosis."""
    wrong = [row for row in rows if row["by"] == OWN and not row["right"]][:MOST_MISSES]
    header = ("kind", "rig", "seed", "case", "truth", "verdict", "best explanation")
    answers = [
        [r["kind"], r["rig"], str(r["seed"]), r["case"], _truth(r), r["verdict"], listed(r["causes"])] for r in wrong
    ]
    return Table(header, answers, "Wrong answers", words=len(header))


def origin(rows: Iterable[Row]) -> str:
    """Number of cases, their seeds, and the states of the code that answered."""
    own = list(rows)
    seeds = ", ".join(str(seed) for seed in sorted({row["seed"] for row in own}))
    by_code = Counter(row["code"] or "an unknown state" for row in own)
    states = ", ".join(f"{code} ({count})" for code, count in by_code.items())
    return f"{len(own)} cases of seeds {seeds}, answered by the code of {states}. Brackets are 95 % intervals."


def listed(causes: Iterable[Sequence[str]]) -> str:
    return " + ".join(f"{effect} at {place}" for effect, place in causes)


def _truth(row: Row) -> str:
    """True causes; laws outside the library by their own name."""
    law = row.get("law") or row["effect"]  # older logs have the latter only
    return listed((law if e == "unknown" else e, p) for e, p in row["truth"]) or "nothing"


def markdown(scores: Tables, rows: Sequence[Row]) -> str:
    """All tables of all rigs, then the wrong answers, as Markdown."""
    parts = []
    for group, by in scores.items():
        parts += [f"## {group}", origin(row for row in rows if row["by"] == OWN and group_of(row) == group)]
        for sheet in sheets(by):
            parts += [f"{sheet.title}:", _table(sheet)]
    missed = misses(rows)
    return "\n\n".join([*parts, f"## {missed.title}", _table(missed)] if missed.rows else parts) + "\n"


def in_words(score: Mapping[str, Any] | None) -> str:
    """Hits of cases with their interval in per cent; or a mean or median with its interval."""
    if not score:
        return ""
    low, high = score["ci95"]
    if "share" in score:
        return f"{score['hits']}/{score['of']} ({100 * low:.0f} .. {100 * high:.0f} %)"
    value = score["mean"] if "mean" in score else score["median"]
    if low is None or low != low:
        return f"{value:.2g}"
    return f"{value:.3g} ({low:.2g} .. {high:.2g})"


def _rows(strata: Mapping[str, Mapping[str, Any]], columns: Iterable[str]) -> list[list[str]]:
    return [[name, *(in_words(scores.get(column)) for column in columns)] for name, scores in strata.items()]


def _table(sheet: Table) -> str:
    lines = [sheet.header, ["---"] * len(sheet.header), *sheet.rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
