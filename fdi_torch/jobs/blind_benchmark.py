"""What is kept of a blind benchmark: judged answers, scores as JSON and as Markdown, a log for the page, plants."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from fdi_torch.blind import Row, Tables, tables
from fdi_torch.blind.files import manifest, read_plant
from fdi_torch.blind.rows import write_rows
from fdi_torch.blind.run import without_nan
from fdi_torch.blind.table import OWN, markdown
from fdi_torch.config.plant_writer import dump_plant
from fdi_torch.disk import write_text
from fdi_torch.logbook import RunLog
from fdi_torch.recordings.source import file_sha256

LOG = "challenge.mcap"


def conclude(out: Path, rows: Sequence[Row], config: Mapping[str, Any], sources: Iterable[Path] = ()) -> Tables:
    """Scores of all rows, written into `out` as rows.jsonl, scores.json, scores.md and challenge.mcap.

    config: what was asked for. sources: files that the rows come from; their hashes go into the log.
    """
    data = [{"path": str(path), "sha256": file_sha256(path)} for path in sources]
    found = tables(rows)
    write_rows(out, rows)
    write_text(out / "scores.json", json.dumps(without_nan(found), indent=1) + "\n")
    write_text(out / "scores.md", markdown(found, rows))
    _log(out / LOG, rows, found, config, data)
    return found


def _log(
    path: Path, rows: Sequence[Row], found: Tables, config: Mapping[str, Any], data: Sequence[Mapping[str, Any]]
) -> None:
    """A trial an answer, in the order of the rows, its kind as its group; an earlier log is replaced."""
    path.unlink(missing_ok=True)
    seeds = {f"challenge_{k + 1}": seed for k, seed in enumerate(sorted({int(row["seed"]) for row in rows}))}
    with RunLog(path, "challenge", config=config, seeds=seeds, data=data) as log:
        for number, row in enumerate(rows):
            log.trial(number, _fields(row), group=row["kind"], seed=row["seed"], status=row["verdict"])
        for group, by in found.items():
            log.result({group: {name: _hits(score) for name, score in by[OWN]["strata"].items()}})


def _fields(row: Row) -> dict[str, Any]:
    """What is not None of the row, causes as texts, less what the message of a trial says anyway."""
    named = {key: [f"{effect}@{place}" for effect, place in row[key]] for key in ("truth", "causes")}
    return {k: v for k, v in row.items() if v is not None and k not in ("kind", "seed", "verdict")} | named


def _hits(score: Mapping[str, Any]) -> dict[str, str]:
    return {n: f"{s['hits']}/{s['of']}" for n, s in score.items() if isinstance(s, Mapping) and "hits" in s}


def write_plants(out: Path) -> None:
    """The nominal plant of each case as a plant file, so that `fdi gap` can be run on a case by hand."""
    for case, line in manifest(out).items():
        path = out / "cases" / f"{case}_plant.yaml"
        if not path.exists():
            path.write_text(dump_plant(read_plant(out, line)), encoding="utf-8")
