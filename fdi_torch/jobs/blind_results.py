"""Result files of a blind benchmark: scored answers, score tables as JSON and Markdown, a log, and plant files."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from fdi_torch.blind.cases import manifest, read_plant
from fdi_torch.blind.score import Row
from fdi_torch.blind.scored_rows import OWN, Tables, markdown, tables, write_rows
from fdi_torch.config.plant_writer import dump_plant
from fdi_torch.disk import write_text
from fdi_torch.estimate.uncertainty import plain_value
from fdi_torch.logbook import RunLog
from fdi_torch.recordings.source import file_sha256

LOG = "challenge.mcap"


def write_results(out: Path, rows: Sequence[Row], config: Mapping[str, Any], sources: Iterable[Path] = ()) -> Tables:
    """Score the rows, and write rows.jsonl, scores.json, scores.md and challenge.mcap into `out`.

    config: settings of the benchmark. sources: files from which the rows come; the log records their hashes.
    """
    data = [{"path": str(path), "sha256": file_sha256(path)} for path in sources]
    scores = tables(rows)
    write_rows(out, rows)
    write_text(out / "scores.json", json.dumps(plain_value(scores, "scores"), indent=1) + "\n")
    write_text(out / "scores.md", markdown(scores, rows))
    _write_log(out / LOG, rows, scores, config, data)
    return scores


def _write_log(
    path: Path, rows: Sequence[Row], scores: Tables, config: Mapping[str, Any], data: Sequence[Mapping[str, Any]]
) -> None:
    """Log each answer as a trial, grouped by kind, in the order of the rows. An earlier log is replaced."""
    path.unlink(missing_ok=True)
    seeds = {f"challenge_{k + 1}": seed for k, seed in enumerate(sorted({int(row["seed"]) for row in rows}))}
    with RunLog(path, "challenge", config=config, seeds=seeds, data=data) as log:
        for number, row in enumerate(rows):
            fields = {key: value for key, value in row.items() if key not in ("kind", "seed", "verdict")}
            fields |= {key: [f"{effect}@{place}" for effect, place in row[key]] for key in ("truth", "causes")}
            log.trial(number, fields, group=row["kind"], seed=row["seed"], status=row["verdict"])
        for group, by in scores.items():
            log.result({group: {name: _hit_counts(score) for name, score in by[OWN]["strata"].items()}})


def _hit_counts(score: Mapping[str, Any]) -> dict[str, str]:
    return {n: f"{s['hits']}/{s['of']}" for n, s in score.items() if isinstance(s, Mapping) and "hits" in s}


def write_plants(out: Path) -> None:
    """Write the nominal plant of each case as a plant file, so that `fdi gap` can be run on a case manually."""
    for case, line in manifest(out).items():
        path = out / "cases" / f"{case}_plant.yaml"
        if not path.exists():
            path.write_text(dump_plant(read_plant(out, line)), encoding="utf-8")
