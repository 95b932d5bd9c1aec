"""The rehearsal job: Monte Carlo validation of a monitor, task by task, logged and resumable."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fdi_torch.config.rehearsal_file import Rehearsal
from fdi_torch.jobs.log_paths import RESUMES
from fdi_torch.jobs.study import copied_trials, new_and_unfinished_log
from fdi_torch.logbook import Listener, RunLog
from fdi_torch.monitor.monte_carlo.tasks import ResultTable


@dataclass(frozen=True)
class RehearsalResult:
    """tables: one per plan. tasks: all; computed: those of this run, in `seconds` s. log: path."""

    tables: tuple[ResultTable, ...]
    tasks: int
    computed: int
    seconds: float
    log: Path


def rehearse(
    rehearsal: Rehearsal,
    resume: bool = False,
    tell: Callable[[float, str], None] = lambda share, text: None,
    listener: Listener | None = None,
) -> RehearsalResult:
    """Compute every task that the log does not have yet. tell(share, text): progress, called before each task."""
    folder = Path(rehearsal.config.output.folder)
    path, before = new_and_unfinished_log(folder, rehearsal.name, rehearsal.text, resume)
    tasks = [task for plan in rehearsal.plans for task in plan.tasks()]
    records = rehearsal.log_records()
    with RunLog(path, "rehearsal", **records, listener=listener, after_interruption=RESUMES) as log:
        results: dict[int, tuple[str, Mapping[str, Any]]] = {
            n: (done.setting, done.numbers) for n, done in copied_trials(log, before).items()
        }
        earlier, started = len(results), time.monotonic()
        for number, task in enumerate(tasks):
            if number not in results:
                tell(len(results) / len(tasks), task.group)
                results[number] = (task.group, dict(task.compute()))
                seed = f"{rehearsal.config.seed}/{number}"
                log.trial(number, results[number][1], group=task.group, seed=seed, status="done")
                log.flush()
        tables = result_tables(rehearsal, [results[number] for number in sorted(results)])
        log.result(
            {"tables": [{"title": t.title, "header": t.header, "rows": t.rows, "said": t.summary} for t in tables]}
        )
    return RehearsalResult(tables, len(tasks), len(results) - earlier, time.monotonic() - started, path)


def result_tables(rehearsal: Rehearsal, results: Sequence[tuple[str, Mapping[str, Any]]]) -> tuple[ResultTable, ...]:
    """Result table of each plan."""
    groups: dict[str, list[Mapping[str, Any]]] = defaultdict(list)
    for group, numbers in results:
        groups[group].append(numbers)
    return tuple(plan.result_table(groups) for plan in rehearsal.plans)
