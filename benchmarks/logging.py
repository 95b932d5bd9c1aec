"""What logging costs: CPU time spent in the log over that of the whole run, and bytes on disk."""

from __future__ import annotations

import functools
import os
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fdi_torch.config.run import load_run
from fdi_torch.config.study import load_study
from fdi_torch.jobs import study as study_job
from fdi_torch.jobs import train as main_job
from fdi_torch.logbook import RunLog, read_run

# Ways into the log. What one of them calls is within its time; the thread that flushes counts too.
DOORS = ("__init__", "__enter__", "__exit__", "write", "recording", "population", "generation", "iteration", "estimate")
DOORS += ("fault", "trial", "summary", "result", "result_arrays", "carry_over", "flush")
Row = tuple[str, int, int, float, float]


class ClockedLog(RunLog):
    """A log that knows the CPU seconds spent in it: of each thread, and of the processes it starts (git)."""

    seconds = 0.0
    _depth = threading.local()


def clocked(method: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(method)
    def run(log: ClockedLog, *arguments: Any, **named: Any) -> Any:
        depth = getattr(ClockedLog._depth, "value", 0)
        ClockedLog._depth.value = depth + 1
        start = _thread_and_children()
        try:
            return method(log, *arguments, **named)
        finally:
            ClockedLog._depth.value = depth
            if depth == 0:
                ClockedLog.seconds += _thread_and_children() - start

    return run


def _thread_and_children() -> float:
    ended = os.times()
    return time.thread_time() + ended.children_user + ended.children_system


for _name in DOORS:
    setattr(ClockedLog, _name, clocked(getattr(RunLog, _name)))


def _train(folder: str, *changes: str) -> Path:
    return main_job.train(load_run(None, [f"output.folder={folder}", *changes])).log


def _study(folder: str, *changes: str) -> Path:
    return study_job.run_study(
        load_study("configs/studies/table3_noise.yaml", [f"output.folder={folder}", *changes])
    ).log


RUNS: dict[str, Callable[[str], Path]] = {
    "built-in run": _train,
    "the same, ten times the search": lambda folder: _train(
        folder, "estimate.search={evaluations: 200000, parameter_tolerance: 0, cost_tolerance: 0, patience: 100000}"
    ),
    "the same, 50,000 samples": lambda folder: _train(folder, "simulate.sample_time=20 ms"),
    "study, 500 trials": lambda folder: _study(folder, "study.trials=500", "study.snr_db=[30]"),
}


def measure(budget: float) -> list[Row]:
    """Run, messages, bytes of the log, CPU seconds of the run, CPU seconds of logging. Compilation comes first."""
    rows: list[Row] = []
    main_job.RunLog = study_job.RunLog = ClockedLog  # type: ignore[misc]
    try:
        with tempfile.TemporaryDirectory() as folder:
            _train(folder)
            for name, run in RUNS.items():
                ClockedLog.seconds, start = 0.0, time.process_time()
                log = run(folder)
                total = time.process_time() - start
                messages = sum(1 for _ in read_run(log).messages())
                rows.append((name, messages, log.stat().st_size, total, ClockedLog.seconds))
    finally:
        main_job.RunLog = study_job.RunLog = RunLog  # type: ignore[misc]
    return rows


def table(rows: list[Row]) -> str:
    lines = [
        "| run | messages | log, kB | bytes a message | CPU s | of it logging | share |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, messages, size, total, logging in rows:
        share = 100 * logging / total
        volume = f"{messages:,} | {size / 1e3:,.0f} | {size / messages:.0f}"
        lines.append(f"| {name} | {volume} | {total:.2f} | {logging:.3f} | {share:.2f} % |")
    return "\n".join(lines)
