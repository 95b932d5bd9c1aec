"""Scored answers as rows, of one benchmark or several, and the scores of rows that belong together."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from fdi_torch.blind.score import Row, by_effect, judge, summary
from fdi_torch.blind.sealed_files import answers, lines_of, manifest, open_key, read_plant
from fdi_torch.blind.sizes import sizes
from fdi_torch.blind.statistics import clopper_pearson
from fdi_torch.disk import write_text
from fdi_torch.plant.description import PlantDescription

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
            share = {"of": len(inside), "hits": hits, "share": hits / len(inside)}
            bins.append(
                {"low": low, "high": high, "stated": mean} | share | {"ci95": clopper_pearson(hits, len(inside))}
            )
    return bins
