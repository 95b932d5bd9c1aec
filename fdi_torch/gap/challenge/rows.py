"""Judged answers: a row each, of one challenge or of several joined, and the scores of all that belong together."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from fdi_torch.gap.challenge.calibration import calibration
from fdi_torch.gap.challenge.files import answers, lines_of, manifest, open_key
from fdi_torch.gap.challenge.plants import Rig
from fdi_torch.gap.challenge.score import Row, by_effect, judge, summary

ROWS = "rows.jsonl"
_SAME = ("rig", "seed", "kind", "index", "by")

Scores = dict[str, Any]
"""strata: {kind or 'all': scores}; by_effect: {effect: scores}; calibration: a bin each."""
Tables = dict[str, dict[str, Scores]]
"""{rig, with or without its effect denied: {whose answers: their scores}}."""


def judged(names: Sequence[str], cases: int, out: Path, rig: Rig) -> list[Row]:
    """Opens the key and judges all answers; the rows are in the folder too."""
    truths, spec = open_key(out), json.loads((out / "spec.json").read_text())
    wanted = set(list(manifest(out))[:cases])
    rows = []
    for name in names:
        about = {"by": name, "rig": rig.plant.name, "seed": spec["seed"]}
        for line in lines_of(answers(out, name)):
            if line["case"] in wanted:
                rows.append(about | _row(line, truths[line["case"]], rig))
    write_rows(out, rows)
    return rows


def _row(line: Mapping[str, Any], truth: Mapping[str, Any], rig: Rig) -> Row:
    about = {key: truth.get(key) for key in ("case", "index", "signal", "colour")}
    about |= {"sec": line["sec"], "code": line.get("code", ""), "gap_rms_m": truth["gap_rms_m"]["recording"]}
    row = about | judge(truth, line["answer"], rig.believed)
    return {key: float(f"{value:.6g}") if isinstance(value, float) else value for key, value in row.items()}


def write_rows(out: Path, rows: Iterable[Row]) -> None:
    (out / ROWS).write_text("".join(json.dumps(row) + "\n" for row in rows))


def joined(folders: Iterable[Path]) -> list[Row]:
    """The rows of several folders. A case that several hold counts once, as it was answered last.

    Raises ValueError for a folder without judged answers.
    """
    found: dict[tuple[Any, ...], Row] = {}
    for folder in folders:
        rows = lines_of(folder / ROWS)
        if not rows:
            raise ValueError(f"{folder}: expected a challenge's folder, got no answers in it; name an --out of before")
        found |= {tuple(row[key] for key in _SAME): row for row in rows}
    return list(found.values())


def tables(rows: Iterable[Row]) -> Tables:
    """Scores of each rig and of each diagnosis of it; cases whose effect is denied stand apart."""
    groups: dict[str, dict[str, list[Row]]] = {}
    for row in rows:
        groups.setdefault(group_of(row), {}).setdefault(row["by"], []).append(row)
    return {group: {name: scores_of(own) for name, own in by.items()} for group, by in groups.items()}


def group_of(row: Row) -> str:
    return f"{row['rig']}, effect left out" if row["kind"] == "left_out" else str(row["rig"])


def scores_of(rows: Sequence[Row]) -> Scores:
    return {"strata": summary(rows), "by_effect": by_effect(rows), "calibration": calibration(rows)}
