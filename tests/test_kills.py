"""Jobs that are killed or interrupted at any moment: whatever looks whole is whole, and the job goes on or starts anew
to the same end.
"""

from __future__ import annotations

import json
import os
import random
import re
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
from matplotlib import image

from fdi_torch import cli
from fdi_torch.logbook import LogError, content_hash, read_run
from tests.test_monitor_follow import config, written

WORDS = {
    "train": ["train"],
    "study": ["study", "--config", "configs/studies/table3_noise.yaml"],
    "gap": ["gap", "--plant", "three_tank", "--recording", "RIG", "--library", "pump_gain"],
    "monitor": ["monitor", "--config", "WATCH"],
    "follow": ["monitor", "--config", "WATCH", "--follow", "--idle", "0.5"],
}
CHANGES = {
    "train": ["simulate.duration=200 s", "estimate.search.evaluations=1500"],
    "study": [
        *("study.steps=[1 s]", "study.data_step=0.2 s", "study.evaluations=600", "study.population=24"),
        *("study.trials=6", "study.block=2", "study.snr_db=[30]"),
    ],
}
RESUMED = ("train", "study", "monitor", "follow")


@dataclass(frozen=True)
class Job:
    """A command that logs into `folder`, and what its undisturbed run took and said."""

    name: str
    words: tuple[str, ...]
    startup: float
    seconds: float
    said: str

    def in_folder(self, folder: Path) -> list[str]:
        return [*self.words, "--out", str(folder), "--quiet"]


@dataclass
class Process:
    """A child of this process, whose libraries are loaded, so that a job begins at once."""

    number: int
    complaints: Path
    code: int | None = None

    def has_ended(self) -> bool:
        if self.code is None:
            ended, status = os.waitpid(self.number, os.WNOHANG)
            self.code = os.waitstatus_to_exitcode(status) if ended else None
        return self.code is not None

    def ending(self) -> tuple[int, str]:
        """Exit code and what it complained of; minus the signal's number where that killed it."""
        deadline = time.monotonic() + 600.0
        while not self.has_ended() and time.monotonic() < deadline:
            time.sleep(0.005)
        assert self.code is not None, "hangs"
        return self.code, self.complaints.read_text()


def started(words: list[str], complaints: Path) -> Process:
    complaints.write_text("")  # a child may be killed before it opens the file
    number = os.fork()
    if number:
        return Process(number, complaints)
    try:
        output = os.open(complaints, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(output, 2)
        sys.stdout, sys.stderr = (open(k, "w", buffering=1, closefd=False) for k in (1, 2))  # noqa: SIM115
        signal.signal(signal.SIGINT, signal.default_int_handler)
        code = cli.main(words)
        sys.stdout.flush()
        os._exit(code)
    finally:
        os._exit(99)


def said(log: Path) -> str:
    """What a job found; of `gap`, whose sums may differ in their last bits from run to run, the verdict in words."""
    run = read_run(log)
    if run.metadata["fdi_torch.run"]["kind"] != "gap":
        return content_hash(run.messages())
    (verdict,) = (message.payload for message in run.messages(["/gap/verdict"]))
    return repr([verdict[name] for name in ("verdict", "causes", "explanations", "locations")])


def log_of(folder: Path) -> Path:
    (log,) = folder.glob("*.mcap")
    return log


def wait_for_log(process: Process, folder: Path) -> None:
    while not list(folder.glob("*.mcap*")) and not process.has_ended():
        time.sleep(0.002)


@pytest.fixture(scope="module", params=WORDS)
def job(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Job:
    """Run once to its end, in a process of its own."""
    name, folder = request.param, tmp_path_factory.mktemp(request.param)
    places = {"RIG": str(written(folder / "rig.csv")), "WATCH": config(folder, faults=["T3.leak.size"])}
    words = [places.get(word, word) for word in WORDS[name]]
    words += [word for change in CHANGES.get(name, ()) for word in ("--set", change)]
    begun = time.monotonic()
    process = started([*words, "--out", str(folder / "out"), "--quiet"], folder / "complaints")
    wait_for_log(process, folder / "out")
    logging = time.monotonic()
    assert process.ending() == (cli.DONE, "")
    return Job(name, tuple(words), logging - begun, time.monotonic() - logging, said(log_of(folder / "out")))


def struck(job: Job, folder: Path, number: signal.Signals, share: float) -> tuple[int, str]:
    """Sends the signal after a share of the time the log is written; below 0, before that. Exit code and complaints."""
    process = started(job.in_folder(folder), folder.with_name(f"{folder.name}.complaints"))
    if share < 0.0:
        time.sleep(-share * job.startup)
    else:
        wait_for_log(process, folder)
        time.sleep(share * job.seconds)
    if not process.has_ended():
        os.kill(process.number, number)
    return process.ending()


def struck_before_its_end(job: Job, below: Path, number: signal.Signals) -> tuple[Path, int, str]:
    """Folder, exit code and complaints of a job that the signal reached, however busy the machine was before or is."""
    for share in (0.4, 0.1, 0.03, 0.01):
        folder = below / f"{share:g}"
        code, complaints = struck(job, folder, number, share)
        if code != cli.DONE:
            break
    return folder, code, complaints


def expect_whole(folder: Path) -> None:
    """Whatever has a final name opens, and so does what is left of an unfinished log."""
    for path in folder.glob("*") if folder.exists() else ():
        if path.suffix == ".mcap":
            log = read_run(path)
            assert log.complete and all(message.payload for message in log.messages())
        elif ".mcap.partial" in path.name and path.stat().st_size > 0:
            try:
                list(read_run(path, salvage=True).messages())
            except LogError as error:
                assert "is no MCAP file" in str(error) and path.stat().st_size < 100, error
        elif path.suffix == ".png" and not path.name.startswith("."):
            assert image.imread(path).size > 1000
        elif path.suffix == ".json" and not path.name.startswith("."):
            json.loads(path.read_text())


def has_ended(folder: Path) -> bool:
    statuses = [read_run(path).metadata["fdi_torch.status"]["status"] for path in folder.glob("*.mcap")]
    return "completed" in statuses


def expect_the_same_end(job: Job, folder: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """Resumed where that is promised, or started anew. Returns what happened."""
    if has_ended(folder):
        return "had ended"
    resumes = job.name in RESUMED and (job.name == "study" or bool(list(folder.glob("*.mcap*"))))
    before = set(folder.glob("*.mcap")) if not resumes else set()
    words = [*job.in_folder(folder), *(["--resume"] if resumes else [])]
    assert cli.main(words) == cli.DONE, capsys.readouterr().err
    (log,) = set(folder.glob("*.mcap")) - before
    assert said(log) == job.said
    return "resumed" if resumes else "started anew"


@pytest.mark.parametrize(
    ("number", "code"),
    [(signal.SIGINT, cli.INTERRUPTED), pytest.param(signal.SIGTERM, cli.TERMINATED, marks=pytest.mark.slow)],
)
def test_what_is_said_of_an_interrupted_job_is_true(
    job: Job, number: signal.Signals, code: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, ended, complaints = struck_before_its_end(job, tmp_path, number)
    assert (ended, complaints.count("\n")) == (code, 1)
    log = log_of(folder)
    anew = "starts again from the beginning; it cannot be resumed"
    going_on = "--resume goes on from there" if job.name in RESUMED else anew
    word = "interrupted" if number == signal.SIGINT else "terminated"
    kept = "what was computed until now is"
    if job.name == "gap":  # its only result comes at the end
        kept = "no answer was computed(, the likeliest so far was [^;]+)?; recordings and progress messages are"
    again = f"the same command {'with ' * (job.name in RESUMED)}{going_on}"
    sentence = f"fdi {job.words[0]}: {word}; {kept} in {re.escape(str(log))}; {again}\n"
    assert re.fullmatch(sentence, complaints), complaints
    assert read_run(log).metadata["fdi_torch.status"]["status"] == "interrupted"
    expect_whole(folder)
    expect_the_same_end(job, folder, capsys)


@pytest.mark.slow
def test_kills_at_any_moment(
    job: Job, tmp_path: Path, capsys: pytest.CaptureFixture[str], pytestconfig: pytest.Config
) -> None:
    """Of each job, a tenth of them before its log is begun. What came of them is printed."""
    draw, kills = random.Random(7), pytestconfig.getoption("--kills")
    ends: dict[str, int] = {}
    for k in range(kills):
        folder, share = tmp_path / str(k), draw.uniform(-0.1, 1.0)
        code, _ = struck(job, folder, signal.SIGKILL, 10 * share if share < 0 else share)
        assert code in (-signal.SIGKILL, cli.DONE)
        expect_whole(folder)
        if job.name not in RESUMED and k < kills - 1:  # it starts anew, whatever the kill left: once is enough
            continue
        end = expect_the_same_end(job, folder, capsys)
        ends[end] = ends.get(end, 0) + 1
        expect_whole(folder)
    assert sum(ends.values()) == (kills if job.name in RESUMED else 1)
    with capsys.disabled():
        sys.stdout.write(f"\n{job.name}: {ends}\n")
