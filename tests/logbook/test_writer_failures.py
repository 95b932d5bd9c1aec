"""Writing of logs: the remaining file after failures of the run, the disk or the machine."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TextIO

import pytest
from example_logs import FIXED, log_generation

from fdi_torch.interruption import Terminated, catch_signals
from fdi_torch.logbook import LogError, RunLog, read_run


@pytest.mark.parametrize(
    ("error", "status", "reason"),
    [
        (KeyboardInterrupt(), "interrupted", "Ctrl-C"),
        (Terminated(), "interrupted", "SIGTERM"),
        (RuntimeError("no water"), "failed", "RuntimeError: no water"),
    ],
)
def test_what_was_logged_before_a_failure_stays(tmp_path: Path, error: BaseException, status: str, reason: str) -> None:
    with pytest.raises(type(error)), RunLog(tmp_path / "a.mcap", "train", **FIXED) as log:
        log_generation(log, 0, 1.0, {"x": 0.5})
        raise error
    run = read_run(tmp_path / "a.mcap")
    assert run.complete and [m.payload["best_cost"] for m in run.messages()] == [1.0]
    assert run.metadata["fdi_torch.status"] | {"ended": ""} == {
        "status": status,
        "reason": reason,
        "ended": "",
        "wall_seconds": "0.000",
    }


def test_an_existing_log_is_not_overwritten(finished: Path) -> None:
    before = finished.read_bytes()
    with pytest.raises(LogError, match=r"run\.mcap: exists already"):
        RunLog(finished, "train", **FIXED).__enter__()
    assert finished.read_bytes() == before


def test_two_writers_on_one_path(tmp_path: Path) -> None:
    with RunLog(tmp_path / "a.mcap", "train", **FIXED) as log:
        with pytest.raises(LogError, match="another run is writing this file"):
            RunLog(tmp_path / "a.mcap", "train", **FIXED).__enter__()
        log.say("still fine")
    assert len(list(read_run(tmp_path / "a.mcap").messages())) == 1


def test_what_a_killed_run_left_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "a.mcap.partial").write_bytes(b"precious")
    with pytest.raises(LogError, match="left by a run that did not end; save it with `fdi recover"):
        RunLog(tmp_path / "a.mcap", "train", **FIXED).__enter__()
    assert (tmp_path / "a.mcap.partial").read_bytes() == b"precious"


def test_a_folder_that_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "logs").write_text("")
    with pytest.raises(LogError, match="a part of the path is a file"):
        RunLog(tmp_path / "logs" / "a.mcap", "train", **FIXED).__enter__()


def run_script(text: str, folder: Path, **options: object) -> subprocess.CompletedProcess[str]:
    root = Path(__file__).parents[2]
    paths = os.pathsep.join([str(root), str(Path(__file__).parent)])
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(text), str(folder)],
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        **options,  # type: ignore[call-overload]
    )


def test_a_read_only_folder(tmp_path: Path) -> None:
    tmp_path.chmod(0o755)
    done = run_script(
        """
        import os, sys
        from fdi_torch.logbook import LogError, RunLog
        RunLog(sys.argv[1] + "/b.mcap", "train")  # imports what it needs while that may be read
        os.chmod(sys.argv[1], 0o555)
        if os.geteuid() == 0:
            os.setgid(65534)
            os.setuid(65534)
        try:
            RunLog(sys.argv[1] + "/a.mcap", "train").__enter__()
        except LogError as error:
            print(error)
        """,
        tmp_path,
    )
    assert "may not be written or read" in done.stdout or "No such file" in done.stderr, done.stderr


@pytest.mark.parametrize("result", ["log.result({'x': 1})", "log.result_arrays(x=[1.0])", ""])
def test_a_process_that_outlives_a_full_disk_does_not_keep_the_log_locked(tmp_path: Path, result: str) -> None:
    """As a notebook does, which then resumes the run."""
    done = run_script(
        f"""
        import resource, sys
        from pathlib import Path
        from fdi_torch.logbook import LogError, RunLog, being_written
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
        try:
            with RunLog(sys.argv[1] + "/a.mcap", "train", env={{}}, git={{}}) as log:
                {result}
                for i in range(100_000):
                    log.trial(i, {{"x": i ** 0.5}})
        except LogError as error:
            print(error)
        print(being_written(Path(sys.argv[1] + "/a.mcap.partial")))
        """,
        tmp_path,
    )
    assert done.stdout.splitlines()[1:] == ["False"], done.stdout + done.stderr


def test_a_full_disk_ends_the_log_not_the_process(tmp_path: Path) -> None:
    """A limit on file size stands in for a full disk: both are an OSError at some write."""
    done = run_script(
        """
        import resource, sys
        from fdi_torch.logbook import LogError, RunLog
        resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))
        log = RunLog(sys.argv[1] + "/a.mcap", "train", env={}, git={})
        try:
            with log:
                written = 0
                try:
                    for i in range(100_000):
                        log.trial(i, {"x": i ** 0.5})
                        written = i
                except LogError as error:
                    print(error)
                try:
                    log.say("one more")
                except LogError as error:
                    print(error)
        except LogError as error:
            print(error)
        print(written)
        """,
        tmp_path,
    )
    assert done.returncode == 0, done.stderr
    first, refused, at_end, written = done.stdout.splitlines()
    assert first.endswith("the limit on file size is reached; raise it (ulimit -f)")
    assert refused.endswith("nothing more is logged") and at_end.endswith("nothing more is logged")
    run = read_run(tmp_path / "a.mcap.partial")
    trials = [message.payload["trial"] for message in run.messages()]
    # The message at which the disk was full may be whole in the file, where the limit cut what followed it.
    assert trials == list(range(len(trials))) and 1000 < len(trials) <= int(written) + 2
    assert "fdi recover" in run.advice


def log_forever(folder: Path, printed: TextIO) -> None:
    """Log trials until a signal ends this process, and print number and time of each."""
    with RunLog(folder / "a.mcap", "train") as log:
        number = 0
        while True:
            log.trial(number, {"x": number**0.5})
            print(number, time.time(), file=printed, flush=True)
            number += 1
            time.sleep(0.7 if number == 5 else 0.002)


class Writer:
    """A child of this process, whose libraries are loaded, that logs until a signal ends it, at the latest the one at
    the end of the `with` block.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(exist_ok=True)
        self.folder, self._printed = folder, folder / "printed"
        self._code: int | None = None
        self._number = os.fork()
        if self._number:
            return
        try:
            catch_signals()
            with self._printed.open("w") as printed:
                log_forever(folder, printed)
        except Terminated as ended:
            os._exit(ended.code)
        finally:
            os._exit(99)

    def __enter__(self) -> Writer:
        return self

    def __exit__(self, *_: object) -> None:
        self.end(signal.SIGKILL)

    def wait_for_trials(self, number: int) -> None:
        """Until it has logged so many."""
        deadline = time.monotonic() + 60.0
        while not self._printed.exists() or self._printed.read_bytes().count(b"\n") < number:
            assert time.monotonic() < deadline, "logs nothing"
            time.sleep(0.001)

    def end(self, signal_number: signal.Signals) -> int:
        """Send the signal, and return the exit code; minus the signal's number where that killed it."""
        if self._code is None:
            os.kill(self._number, signal_number)
            self._code = os.waitstatus_to_exitcode(os.waitpid(self._number, 0)[1])
        return self._code

    def times(self) -> dict[int, float]:
        """When each trial was logged."""
        lines = [line.split() for line in self._printed.read_text().splitlines(keepends=True) if line.endswith("\n")]
        return {int(number): float(moment) for number, moment in lines}


def test_sigterm_finishes_the_log(tmp_path: Path) -> None:
    with Writer(tmp_path) as writer:
        writer.wait_for_trials(3)
        assert writer.end(signal.SIGTERM) == 143
    run = read_run(tmp_path / "a.mcap")
    assert run.complete and run.metadata["fdi_torch.status"]["reason"] == "SIGTERM"


def check_kills(folder: Path, seconds: Sequence[float]) -> None:
    """Kill writers that run side by side, each so long after its first trial; the times ascend."""
    with ExitStack() as stack:
        writers, logging = [stack.enter_context(Writer(folder / f"{duration:g}")) for duration in seconds], []
        for writer in writers:
            writer.wait_for_trials(1)
            logging.append(time.monotonic())
        for writer, begun, duration in zip(writers, logging, seconds, strict=True):
            time.sleep(max(begun + duration - time.monotonic(), 0.0))
            killed = time.time()
            assert writer.end(signal.SIGKILL) == -signal.SIGKILL
            check_what_is_left(writer.folder, writer.times(), killed)


def check_what_is_left(folder: Path, times: dict[int, float], killed: float) -> None:
    run = read_run(folder / "a.mcap.partial")
    assert not run.complete and run.metadata["fdi_torch.run"]["kind"] == "train"
    kept = {message.payload["trial"] for message in run.messages()}
    lost = [number for number in times if number not in kept]
    assert all(times[number] > killed - 1.0 for number in lost)


@pytest.mark.parametrize("seconds", [0.0, 0.65, 1.5])
def test_a_kill_loses_at_most_the_last_second(tmp_path: Path, seconds: float) -> None:
    """The second kill falls into a silence after a few messages, which only a clock can save."""
    check_kills(tmp_path, [seconds])


@pytest.mark.slow
def test_fifty_kills_lose_at_most_the_last_second_each(tmp_path: Path) -> None:
    for first in range(0, 50, 5):
        check_kills(tmp_path, [0.03 * number for number in range(first, first + 5)])


def test_a_log_whose_name_was_taken_meanwhile_is_kept_under_its_partial_name(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="it is a folder"), RunLog(tmp_path / "a.mcap", "train", **FIXED) as log:
        log.say("hello")
        (tmp_path / "a.mcap").mkdir()
    assert read_run(tmp_path / "a.mcap.partial").complete
