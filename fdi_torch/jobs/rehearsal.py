"""A whole rehearsal: pieces computed one after the other, logged as they come, resumed, and put into tables."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fdi_torch.config.rehearsal_file import Rehearsal
from fdi_torch.jobs.log_paths import RESUMES
from fdi_torch.jobs.study import carried_over, log_and_earlier
from fdi_torch.logbook import Listener, RunLog
from fdi_torch.monitor.rehearsal.pieces import Shown


@dataclass(frozen=True)
class Rehearsed:
    """tables: one a rehearsal. computed: pieces of this run, of `pieces`. seconds: they took. log: where all lies."""

    tables: tuple[Shown, ...]
    pieces: int
    computed: int
    seconds: float
    log: Path


def rehearse(
    rehearsal: Rehearsal,
    resume: bool = False,
    tell: Callable[[float, str], None] = lambda share, text: None,
    listener: Listener | None = None,
) -> Rehearsed:
    """Computes every piece that the log does not hold yet. tell(share, text) is called after each."""
    folder = Path(rehearsal.config.output.folder)
    path, before = log_and_earlier(folder, rehearsal.name, rehearsal.text, resume)
    pieces = [piece for plan in rehearsal.plans for piece in plan.pieces()]
    seeds = {"seed": rehearsal.config.seed}
    with RunLog(
        path,
        "rehearsal",
        config_text=rehearsal.text,
        config=rehearsal.resolved,
        seeds=seeds,
        listener=listener,
        after_interruption=RESUMES,
    ) as log:
        known: dict[int, tuple[str, Mapping[str, Any]]] = {
            n: (done.setting, done.numbers) for n, done in carried_over(log, before).items()
        }
        found, started = len(known), time.monotonic()
        for number, piece in enumerate(pieces):
            if number not in known:
                tell(len(known) / len(pieces), piece.group)
                known[number] = (piece.group, dict(piece.compute()))
                seed = f"{rehearsal.config.seed}/{number}"
                log.trial(number, known[number][1], group=piece.group, seed=seed, status="done")
                log.flush()
        tables = tabled(rehearsal, [known[number] for number in sorted(known)])
        log.result({"tables": [{"title": t.title, "header": t.header, "rows": t.rows, "said": t.said} for t in tables]})
    return Rehearsed(tables, len(pieces), len(known) - found, time.monotonic() - started, path)


def tabled(rehearsal: Rehearsal, known: Sequence[tuple[str, Mapping[str, Any]]]) -> tuple[Shown, ...]:
    """Every plan's table of what there is."""
    groups: dict[str, list[Mapping[str, Any]]] = defaultdict(list)
    for group, numbers in known:
        groups[group].append(numbers)
    return tuple(plan.shown(groups) for plan in rehearsal.plans)
