"""What logging costs, over every command that logs: CPU time spent in the log over that of the run, and bytes on disk.

Counted is the time of every method of the log and of what a search works out to log it, on each thread, and of the
process that asks git. A job's seconds do not hold the imports; those of the whole command, as it is typed, do.
"""

from __future__ import annotations

import contextlib
import functools
import io
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from fdi_torch.cli import main
from fdi_torch.jobs.train import SearchLogger
from fdi_torch.logbook import RunLog, read_run

Row = tuple[str, int, int, float, float, float]

# A reading a second, of a rig with a small leak throughout.
MONITOR = """
plant: three_tank
recording: {file: FILE}
fault_free: [0 s, 1000 s]
faults: [T1.leak.size, T3.leak.size, P13.plugging.size]
"""
LONG = "simulate.sample_time=20 ms"
TEN_TIMES = "estimate.search={evaluations: 200000, parameter_tolerance: 0, cost_tolerance: 0, patience: 100000}"
STUDY = ("study", "--config", "configs/studies/table3_noise.yaml", "--set", "study.snr_db=[30]", "--set")
REHEARSAL = ("rehearse", "--config", "configs/rehearsals/false_alarms.yaml", "--set")
RUNS: dict[str, tuple[str, ...]] = {
    "train: the built-in run": ("train",),
    "train: ten times the search": ("train", "--set", TEN_TIMES),
    "train: 50,000 samples": ("train", "--set", LONG),
    "study: 500 trials": (*STUDY, "study.trials=500"),
    "monitor: 10,000 samples": ("monitor", "--config", "MONITOR"),
    "rehearse: 20 runs of an hour": (*REHEARSAL, "false_alarms={noises: {white: {}}, runs: 20, calibrations: 2}"),
    "gap: 1,000 samples, all effects": ("gap", "--plant", "three_tank", "--recording", "RECORDING"),
    "challenge: 1 rig": ("challenge", "--cases", "1", "--kinds", "single"),
}
"""MONITOR and RECORDING stand for files that are made first."""


class Clock:
    """CPU seconds of a group of methods, of each thread; asking: of the processes that a new log starts."""

    def __init__(self) -> None:
        self.seconds = self.asking = 0.0
        self._inside = threading.local()

    def within(self, method: Callable[..., Any]) -> Callable[..., Any]:
        """The same method, its seconds counted unless another counted one has called it."""

        @functools.wraps(method)
        def run(*arguments: Any, **named: Any) -> Any:
            if getattr(self._inside, "one", False):
                return method(*arguments, **named)
            asks = method.__name__ == "__init__"  # git
            self._inside.one, children, start = True, asks and _children(), time.thread_time()
            try:
                return method(*arguments, **named)
            finally:
                self._inside.one = False
                self.seconds += time.thread_time() - start
                self.asking += _children() - children if asks else 0.0

        return run


@contextlib.contextmanager
def clocked(clock: Clock) -> Iterator[None]:
    """While it lasts, the clock runs in every method of a log and in those that collect what a search logs."""
    doors: list[tuple[type, str]] = [(SearchLogger, "write")]
    doors += [(RunLog, name) for name in dir(RunLog) if name in ("__init__", "__enter__", "__exit__") or name[0] != "_"]
    own = {(kind, name): vars(kind).get(name) for kind, name in doors}
    for kind, name in doors:
        method = getattr(kind, name)
        if callable(method) and not isinstance(vars(kind).get(name), staticmethod):
            setattr(kind, name, clock.within(method))
    try:
        yield
    finally:
        for (kind, name), method in own.items():
            if method is None and name in vars(kind):
                delattr(kind, name)
            elif method is not None:
                setattr(kind, name, method)


def measure(budget: float) -> list[Row]:
    """Run, messages, bytes of the log, CPU seconds of the job, of its logging, and of the imports before it.

    Compilation comes first.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        files = prepared(folder)
        run(("train",), folder / "compiled")
        rows = [one(what, [files.get(word, word) for word in words], folder / str(k)) for k, (what, words) in runs()]
        before = as_typed(folder / "typed") - rows[0][3]
    return [(*row, before) for row in rows]


def runs() -> Iterator[tuple[int, tuple[str, tuple[str, ...]]]]:
    return iter(enumerate(RUNS.items()))


def prepared(folder: Path) -> dict[str, str]:
    """The files that jobs need."""
    files = {}
    for what, duration, fault in (("MONITOR", 10_000, 0.05), ("RECORDING", 1000, 0.3)):
        sets = (f"simulate.duration={duration} s", f"simulate.faults={{T1.leak: {fault}}}")
        words = [word for change in sets for word in ("--set", change)]
        recording = run(("simulate", *words), folder / what, "*.csv")
        files[what] = str(recording)
        if what == "MONITOR":
            files[what] = str(folder / "monitor.yaml")
            Path(files[what]).write_text(MONITOR.replace("FILE", str(recording)), encoding="utf-8")
    return files


def as_typed(folder: Path) -> float:
    """CPU seconds of the built-in run in a process of its own: the job, and the imports before it."""
    start = _children()
    words = [sys.executable, "-m", "fdi_torch", "train", "--quiet", "--out", str(folder)]
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
    return _children() - start


def one(what: str, words: list[str], folder: Path) -> tuple[str, int, int, float, float]:
    clock, start = Clock(), time.process_time()
    with clocked(clock):
        log = run(words, folder)
    total = time.process_time() - start + clock.asking
    messages = sum(1 for _ in read_run(log).messages())
    return what, messages, log.stat().st_size, total, clock.seconds + clock.asking


def run(words: tuple[str, ...] | list[str], folder: Path, wanted: str = "*.mcap") -> Path:
    """Runs a command silently; the largest file of the wanted kind that it wrote."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as said:
        code = main([*words, "--out", str(folder), "--quiet"])
    found = sorted(folder.rglob(wanted), key=lambda path: path.stat().st_size)
    if not found:
        raise RuntimeError(f"expected {wanted} of `fdi {' '.join(words)}`, got code {code}: {said.getvalue()}")
    return found[-1]


def _children() -> float:
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    return spent.ru_utime + spent.ru_stime


def table(rows: list[Row]) -> str:
    lines = [
        "| run | messages | log, kB | bytes a message | CPU s | of it logging | share | of the whole command |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, messages, size, total, logging, before in rows:
        job, whole = 100 * logging / total, 100 * logging / (total + before)
        volume = f"{messages:,} | {size / 1e3:,.0f} | {size / messages:.0f}"
        lines.append(f"| {name} | {volume} | {total:.2f} | {logging:.4f} | {job:.2f} % | {whole:.2f} % |")
    return "\n".join(lines)
