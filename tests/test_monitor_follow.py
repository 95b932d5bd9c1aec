"""The monitor on files that grow, in their logs, and on what users get wrong."""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
import yaml

from fdi_torch.cli import INTERRUPTED, main
from fdi_torch.config.monitor_file import load_monitor
from fdi_torch.config.plant_file import load_plant
from fdi_torch.config.plant_writer import plant_mapping
from fdi_torch.config.problems import ConfigError
from fdi_torch.jobs.log_paths import left_unfinished
from fdi_torch.jobs.logged_monitor import MonitorCallbacks
from fdi_torch.jobs.monitor import LARGEST_BATCH, DelayWatch, LiveBatches
from fdi_torch.jobs.monitor_rows import LearningItems, resumed_items, rows_until
from fdi_torch.jobs.replay import repeat_run
from fdi_torch.live.row_buffer import Row
from fdi_torch.logbook import RunLog, content_hash, follow, read_run, series
from fdi_torch.recordings.csv_growing import GrowingCsv
from tests.test_monitor import recorded, step_to

FAULT, ONSET, SAMPLES = "T3.leak.size", 200.0, 300
HEADER = "t_s,Q1_cm3_s,Q2_cm3_s,h1_cm,h2_cm,h3_cm\n"


@lru_cache
def readings(size: float = 0.05, onset: float = ONSET) -> list[list[float]]:
    """Levels of the three tanks in m, once a second, with 1 mm of noise and a leak from `onset` on."""
    return recorded(step_to(FAULT, size, onset), SAMPLES, seed=2).readings.tolist()


def row(t: float, levels: Sequence[float]) -> str:
    return f"{t:g},50,50," + ",".join(f"{100 * h:.4f}" for h in levels) + "\n"


def written(path: Path, size: float = 0.05, onset: float = ONSET) -> Path:
    lines = [row(k, levels) for k, levels in enumerate(readings(size, onset))]
    path.write_text(HEADER + "".join(lines))
    return path


def config(folder: Path, **changes: object) -> str:
    """A monitor file for `rig.csv` in the folder."""
    data = {
        "plant": "three_tank",
        "recording": {"file": "rig.csv"},
        "fault_free": ["0 s", "150 s"],
        "faults": ["T1.leak.size", "T3.leak.size", "h2.sensor_bias.bias"],
        "window": {"lookback": "100 s", "confirm": "30 s", "longest": "200 s", "incipient": False, "together": 1},
        "output": {"folder": str(folder / "logs")},
    }
    path = folder / "watch.yaml"
    path.write_text(yaml.safe_dump(data | changes))
    return str(path)


def monitored(words: Sequence[str], capsys: pytest.CaptureFixture[str]) -> list[dict[str, object]]:
    """The events that `fdi monitor` prints."""
    assert main(["monitor", *words, "--json", "--quiet"]) == 0
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def kinds(events: Sequence[dict[str, object]]) -> list[object]:
    return [event["kind"] for event in events if event["kind"] not in ("notice", "watching", "summary")]


def texts(events: Sequence[dict[str, object]]) -> str:
    return " | ".join(str(event["text"]) for event in events if event["kind"] == "notice")


def growing(write: Callable[[], None]) -> threading.Thread:
    thread = threading.Thread(target=write)
    thread.start()
    return thread


def test_a_growing_csv_file_is_followed_row_by_row(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], watched: tuple[Path, list[dict[str, object]]]
) -> None:
    """In pieces that end within a row, with a row that is no row, one that comes twice, and a hole in the clock."""
    file = tmp_path / "rig.csv"
    file.write_text(HEADER)
    rows = [row(k if k < 280 else k + 40, levels) for k, levels in enumerate(readings())]
    rows.insert(50, "50,oops,50,1,2,3\n")
    rows.insert(120, rows[119])
    text = "".join(rows)

    def write() -> None:
        with file.open("a") as handle:
            for first in range(0, len(text), 1500):
                handle.write(text[first : first + 1500])
                handle.flush()
                time.sleep(0.02)

    thread = growing(write)
    events = monitored(["--config", config(tmp_path), "--follow", "--idle", "1.5"], capsys)
    thread.join()
    assert kinds(events)[:2] == ["alarm", "isolated"]
    assert "got 'oops'; say what it means, as in words: {oops: null}" in texts(events)
    assert "no samples for 41 s" in texts(events)
    alarms, whole = ([e["time"] for e in each if e["kind"] == "alarm"] for each in (events, watched[1]))
    assert alarms == whole


def test_following_shows_the_last_sample_the_delay_and_the_events(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """There is no end yet, hence no share of it."""
    told: list[tuple[float | None, str]] = []

    def noting(tell: Callable[[float | None, str], None], *others: Any) -> MonitorCallbacks:
        return MonitorCallbacks(lambda *step: (told.append(step), tell(*step)), *others)

    monkeypatch.setattr("fdi_torch.cli.monitor.MonitorCallbacks", noting)
    written(tmp_path / "rig.csv")
    assert main(["monitor", "--config", config(tmp_path), "--follow", "--idle", "0.2"]) == 0
    progress = [line for line in capsys.readouterr().err.splitlines() if line.startswith("monitor ")]
    assert re.search(r"^monitor (waiting for samples|last sample at \d+ s)", progress[1])
    assert not any("%" in line for line in progress)
    share, text = told[-1]
    assert share is None
    assert re.fullmatch(rf"last sample at {SAMPLES - 1} s, \d+\.\d s behind; [1-9]\d* events", text)


def test_a_growing_log_is_followed_until_its_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "rig.mcap"
    started = threading.Event()

    def write() -> None:
        with RunLog(path, "rig", flush_seconds=0.05) as log:
            for k, levels in enumerate(readings()):
                log.write("/plant/input", {"Q1": 50.0, "Q2": 50.0}, k, units={"Q1": "cm^3/s", "Q2": "cm^3/s"})
                log.write("/plant/output", dict(zip(("h1", "h2", "h3"), levels, strict=True)), k,
                           units=dict.fromkeys(("h1", "h2", "h3"), "m"))  # fmt: skip
                if k % 25 == 0:
                    log.flush()
                    started.set()
                    time.sleep(0.02)

    thread = growing(write)
    started.wait(10.0)
    events = monitored(["--config", config(tmp_path, recording={"file": "rig.mcap"}), "--follow"], capsys)
    thread.join()
    assert kinds(events)[:2] == ["alarm", "isolated"]
    found = next(event for event in events if event["kind"] == "isolated")
    assert found["faults"] == [FAULT]


def test_every_event_lies_in_the_log_from_which_a_page_is_made(
    tmp_path: Path, watched: tuple[Path, list[dict[str, object]]]
) -> None:
    folder, events = watched
    [path] = (folder / "logs").glob("*.mcap")
    run = read_run(path)
    logged = [message.payload for message in run.messages(["/observer/alarm"])]
    assert [m["event"] for m in logged] == [e["kind"] for e in events]
    assert [m["message"] for m in logged] == [e["text"] for e in events]
    isolated = next(m for m in logged if m["event"] == "isolated")
    assert isolated["faults"] == [FAULT] and isolated["sizes"][0] == pytest.approx(0.05, abs=4 * isolated["stds"][0])
    fault = [message.payload for message in run.messages(["/diagnosis/fault"])][-1]
    assert (fault["location"], fault["fault"], fault["present"]) == ("T3", "leak.size", True)
    assert sum(1 for _ in run.messages(["/observer/residual"])) == SAMPLES - 1
    assert main(["report", str(path), "--out", str(tmp_path), "--quiet"]) == 0
    page = next(tmp_path.rglob("*.html"))
    assert "leak at T3 (size 0.0" in page.read_text()


@pytest.mark.parametrize("options", ["", "--json --follow --idle 0.5"])
def test_who_stops_reading_events_ends_neither_the_monitor_nor_its_log(options: str, tmp_path: Path) -> None:
    written(tmp_path / "rig.csv")
    words = f"{sys.executable} -m fdi_torch monitor --config {config(tmp_path)} --quiet {options}"
    piped = f"{words} | head -1; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", piped], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr, done.stdout.count("\n")) == (0, "", 1)
    [path] = (tmp_path / "logs").glob("*.mcap")
    assert read_run(path).metadata["fdi_torch.status"]["status"] == "completed"
    assert [e["event"] for e in logged_events(path)][-1] == "summary"


def test_ctrl_c_keeps_what_was_logged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written(tmp_path / "rig.csv")
    from fdi_torch.monitor.monitor import Monitor

    advance = Monitor.advance

    def interrupted(self, state, samples, show=None):  # type: ignore[no-untyped-def]
        if float(samples.time[-1]) > 280.0:
            raise KeyboardInterrupt
        return advance(self, state, samples, show)

    monkeypatch.setattr(Monitor, "advance", interrupted)
    monkeypatch.setattr("fdi_torch.jobs.logged_monitor.CHUNK", 20)
    assert main(["monitor", "--config", config(tmp_path), "--quiet"]) == INTERRUPTED
    [path] = (tmp_path / "logs").glob("*.mcap")
    assert "alarm" in [message.payload["event"] for message in read_run(path).messages(["/observer/alarm"])]


def test_faults_and_constants_may_be_named_by_a_pattern(tmp_path: Path) -> None:
    run = load_monitor(config(tmp_path, faults=["T1.leak", "*.leak"], calibrate=["*.discharge_coefficient"]))
    assert run.config.faults == ["T1.leak.size", "T2.leak.size", "T3.leak.size"]
    assert run.config.calibrate == [f"{pipe}.discharge_coefficient" for pipe in ("P13", "P32", "OUT2")]
    with pytest.raises(ConfigError, match=r"faults: expected a pattern such as \*\.leak or P1\.\*, got '\*\.leek'"):
        load_monitor(config(tmp_path, faults=["*.leek"]))


@pytest.mark.parametrize("mode", ["evolution", "least_squares"])
def test_window_after_window_all_faults_are_fitted_and_go_back(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], mode: str
) -> None:
    written(tmp_path / "rig.csv", size=0.1, onset=150.0)
    window = {"lookback": "50 s", "longest": "149 s"}
    faults = ["T1.leak.size", "T3.leak.size"]
    words = config(tmp_path, mode=mode, window=window, faults=faults, fault_free=["0 s", "140 s"])
    events = monitored(["--config", words], capsys)
    assert kinds(events)[:3] == ["estimate", "alarm", "estimate"]
    sound, faulty = (event for event in events if event["kind"] == "estimate")
    assert sound["sizes"] == pytest.approx([0.0, 0.0], abs=0.02)
    # Correlation is blind to gain and offset, which is most of what a level shows soon after a leak opened.
    assert faulty["sizes"] == pytest.approx([0.0, 0.1], abs=0.15 if mode == "evolution" else 0.02)
    assert ("±" in str(faulty["text"])) == (mode != "evolution")


def test_a_window_mode_needs_a_whole_window(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    written(tmp_path / "rig.csv")
    assert (
        main(["monitor", "--config", config(tmp_path, mode="least_squares"), "--set", "window.longest=1 h", "--quiet"])
        == 2
    )
    assert "expected a recording of at least one window (3600 s)" in capsys.readouterr().err
    words = ["--set", "window.longest=100 s", "--set", "window.stride=200 s", "--quiet"]
    assert main(["monitor", "--config", config(tmp_path, mode="least_squares"), *words]) == 2
    assert "a stride within it" in capsys.readouterr().err


def test_a_window_longer_than_the_recording_ends_at_its_beginning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    written(tmp_path / "rig.csv")
    window = {"lookback": "100 s", "confirm": "30 s", "longest": "5000 s", "incipient": False, "together": 1}
    assert "isolated" in kinds(monitored(["--config", config(tmp_path, window=window)], capsys))


def test_a_monitor_without_an_alarm_says_so_at_the_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    written(tmp_path / "rig.csv", 0.0)
    assert main(["monitor", "--config", config(tmp_path)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "no alarm"


def test_a_fault_within_the_part_taken_for_fault_free_is_suspected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    written(tmp_path / "rig.csv", size=0.2, onset=60.0)
    events = monitored(["--config", config(tmp_path)], capsys)
    said = texts(events)
    assert re.search(
        r"leak at T3 \(size 0.*\) since 60 s, probability over 99 %, explains the part taken for fault-free", said
    )


@pytest.mark.parametrize("part", [["400 s", "500 s"], ["150 s", "0 s"], ["0 s", "20 s"], ["0 s", "9000 s"]])
def test_a_fault_free_part_that_is_none_is_named(
    part: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    written(tmp_path / "rig.csv")
    assert main(["monitor", "--config", config(tmp_path, fault_free=part), "--quiet"]) == 2
    assert f"watch.yaml: fault_free: {tmp_path}" in capsys.readouterr().err
    override = f"fault_free=[{', '.join(part)}]"
    assert main(["monitor", "--config", config(tmp_path), "--set", override, "--quiet"]) == 2
    assert capsys.readouterr().err.startswith(f"fdi monitor: --set {override}: fault_free: {tmp_path}")


def test_a_fault_that_was_there_before_the_recording_is_said_to_be(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Sound at first for learning, then a recording of another day that starts with the leak at its full size."""
    levels = [*readings(onset=1e9)[:160], *readings(size=0.1, onset=0.0)[160:]]
    times = [*range(160), *range(1000, 1000 + len(levels) - 160)]
    lines = [row(t, values) for t, values in zip(times, levels, strict=True)]
    (tmp_path / "rig.csv").write_text(HEADER + "".join(lines))
    events = monitored(["--config", config(tmp_path)], capsys)
    found = next(event for event in events if event["kind"] == "isolated")
    assert found["faults"] == [FAULT] and "it may have been there before" in str(found["text"])


def test_a_file_that_cannot_be_followed_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "rig.csv").write_text(HEADER)
    thinned = config(tmp_path, recording={"file": "rig.csv", "every": 2})
    assert main(["monitor", "--config", thinned, "--follow", "--quiet"]) == 2
    assert "expected neither mask nor every" in capsys.readouterr().err
    (tmp_path / "other.csv").write_text("t_s,Q1_cm3_s\n")
    for name in ("no.mcap", "no.csv", "other.csv"):
        assert main(["monitor", "--config", config(tmp_path, recording={"file": name}), "--follow", "--quiet"]) == 2
    assert not list(tmp_path.rglob("*.mcap*")), "no log of a run that never began"
    assert main(["monitor", "--config", config(tmp_path), "--follow", "--idle", "0.2", "--quiet"]) == 2
    assert "expected samples to follow, got 0; check that" in capsys.readouterr().err
    with RunLog(tmp_path / "bare.mcap", "rig") as log:
        log.write("/plant/input", {"Q1": 1.0, "Q2": 1.0}, 0.0)
    assert main(["monitor", "--config", config(tmp_path, recording={"file": "bare.mcap"}), "--follow", "--quiet"]) == 2
    assert "expected a unit, got none" in capsys.readouterr().err


def test_a_wild_time_stamp_neither_ends_the_learning_nor_the_monitor(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One stamp far ahead while learning and one afterwards, all rows at once: as if they came one by one."""
    levels = readings(size=0.1)
    lines = [row(k, each) for k, each in enumerate(levels)]
    for k in (20, 180):
        lines[k] = row(1e6 + k, levels[k])
    (tmp_path / "rig.csv").write_text(HEADER + "".join(lines))
    events = monitored(["--config", config(tmp_path), "--follow", "--idle", "0.2"], capsys)
    assert texts(events).count("the clock jumps back") == 2
    assert kinds(events)[:2] == ["alarm", "isolated"]
    assert next(event for event in events if event["kind"] == "isolated")["faults"] == [FAULT]


def test_the_part_to_learn_from_is_the_first_that_reaches_its_end() -> None:
    def at(*times: float) -> list[tuple[float, list[float], list[float]]]:
        return [(float(t), [], []) for t in times]

    once = at(*range(101))
    assert rows_until(once, 100.0) == once and rows_until(once[:-1], 100.0) == []
    wild = [*at(*range(20)), *at(1e6), *at(*range(21, 300))]
    assert [r[0] for r in rows_until(wild, 100.0)] == [float(t) for t in range(21, 101)]
    restarted = at(*range(120), *range(120))
    assert rows_until(restarted, 100.0) == once
    gap = at(*range(60), *range(150, 170))
    assert len(rows_until(gap, 100.0)) == 70 and rows_until(gap[:69], 100.0) == []
    assert len(rows_until(at(*range(50), *range(49, 101)), 100.0)) == 101


def test_arrivals_come_in_batches_and_with_their_errors() -> None:
    def source():  # type: ignore[no-untyped-def]
        yield from range(5)
        raise ValueError("torn")

    arrivals, got = LiveBatches(source()), []
    with pytest.raises(ValueError, match="torn"):
        for batch in arrivals:
            got += batch
    assert got == list(range(5))
    assert [item for batch in LiveBatches(iter("abc")) for item in batch] == ["a", "b", "c"]


def test_what_comes_while_the_noise_is_learnt_is_kept_for_a_resumed_run(tmp_path: Path) -> None:
    """Learning occupies the main thread, which has taken one batch only."""
    rows: list[Row | str] = [(float(k), [1.0], [math.nan]) for k in range(50)]
    learning, delivered = LearningItems(tmp_path / "watch.mcap"), threading.Event()

    def source() -> Iterator[Row | str]:
        yield from rows
        delivered.set()
        yield "connection lost"

    batches = LiveBatches(learning.keeping(source(), lambda: 7.0))
    taken = len(next(batches))
    assert delivered.wait(10.0) and taken <= len(rows) + 1
    items, zero = LearningItems(tmp_path / "watch.mcap").read()
    assert str(items[: len(rows)]) == str(rows) and zero == 7.0 and learning.count >= len(rows)
    learning.end()
    assert not learning.path.exists() and sum(map(len, batches)) == len(rows) + 1 - taken


def test_a_torn_line_of_what_was_kept_does_not_hide_what_follows(tmp_path: Path) -> None:
    """A full disk or a lost power supply tears the last line of one run; the next run writes on."""
    rows: list[Row | str] = [(float(k), [1.0], [2.0]) for k in range(20)]
    path = LearningItems(tmp_path / "watch.mcap").path
    for cut in (1, 4):
        path.unlink(missing_ok=True)
        list(LearningItems(tmp_path / "watch.mcap").keeping(iter(rows[:5]), lambda: None))
        path.write_bytes(path.read_bytes()[:-cut])
        assert LearningItems(tmp_path / "watch.mcap").read()[0] == rows[:4]
        list(LearningItems(tmp_path / "watch.mcap").keeping(iter(rows), lambda: None))
        assert LearningItems(tmp_path / "watch.mcap").read()[0] == rows


def test_lateness_and_bursts_are_told_once_until_they_double() -> None:
    wall = [100.0]
    delay_watch = DelayWatch(lambda: wall[0])
    assert delay_watch.received([0.0, 1.0, 2.0]) == [] and delay_watch.processed(2.0) == []
    wall[0] += 30.0
    assert (
        "31 samples came at once after 30.0 s of silence" in delay_watch.received([float(t) for t in range(3, 34)])[0]
    )
    assert delay_watch.processed(33.0) == []
    wall[0] += 40.0
    assert delay_watch.received([34.0]) == []
    assert "39.0 s behind real time" in delay_watch.processed(34.0)[0]
    wall[0] += 2.0
    assert delay_watch.processed(35.0) == []
    delay_watch.clock_jumped()
    assert delay_watch.processed(0.0) == []


@pytest.mark.parametrize("look", range(4))
def test_a_log_that_ends_between_two_looks_is_read_once(
    look: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "rig.mcap"
    stack = ExitStack()
    log = stack.enter_context(RunLog(path, "rig", flush_seconds=0.0))
    log.write("/plant/output", {"h1": 0.5}, 0.0, units={"h1": "m"})
    log.flush()
    exists, looks = Path.exists, iter(range(100))

    def ends_when_looked_at(self: Path) -> bool:
        found = exists(self)
        if found and self.suffix == ".partial" and next(looks) == look:
            monkeypatch.setattr(Path, "exists", exists)
            log.write("/plant/output", {"h1": 0.4}, 1.0, units={"h1": "m"})
            stack.close()
        return found

    monkeypatch.setattr(Path, "exists", ends_when_looked_at)
    assert [m.payload["h1"] for m in follow(path, {"/plant/output"}, 5.0, 0.01)] == [0.5, 0.4]


def logged_events(path: Path) -> list[dict[str, object]]:
    return [message.payload for message in read_run(path).messages(["/observer/alarm"])]


def test_a_followed_file_that_becomes_shorter_is_named(tmp_path: Path) -> None:
    file = written(tmp_path / "rig.csv")
    growing = GrowingCsv(file, ["Q1", "Q2"], ["h1", "h2", "h3"])
    assert len(growing.new()[0]) == SAMPLES
    file.write_text(HEADER + row(0.0, [0.1, 0.1, 0.1]))
    with pytest.raises(ValueError, match="has become shorter; it was replaced or cut"):
        growing.new()


@pytest.mark.parametrize(("rotated", "dated"), [(False, False), (True, False), (True, True)])
def test_a_growing_file_is_followed_on_after_a_kill_to_the_same_events(
    rotated: bool, dated: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed between alarm and isolation, with unreadable rows before and after; rotated: the file then holds only what
    came since; dated: time 0 is the date of the first row of the first file.
    """
    whole, file = written(tmp_path / "all.csv"), tmp_path / "rig.csv"
    lines = whole.read_text().splitlines(keepends=True)
    if dated:
        moments = (f"2026-11-30T08:{k // 60:02}:{k % 60:02}+01:00" for k in range(SAMPLES))
        lines = [
            HEADER.replace("t_s", "time"),
            *(f"{t},{line.partition(',')[2]}" for t, line in zip(moments, lines[1:], strict=True)),
        ]
    if not rotated:  # their sentences name the line
        lines.insert(270, "50,oops,50,1,2,3\n")
    lines.insert(60, "50,oops,50,1,2,3\n")
    whole.write_text("".join(lines))
    all_of_it = ["--config", config(tmp_path, recording={"file": "all.csv"}), "--follow", "--idle", "0.3"]
    expected = monitored(all_of_it, capsys)
    file.write_text("".join(lines[:225]))
    words = ["--config", config(tmp_path), "--follow", "--idle", "0.3"]
    with monkeypatch.context() as patch:

        def killed(self: object) -> None:
            raise KeyboardInterrupt

        patch.setattr("fdi_torch.jobs.logged_monitor.LoggedMonitor.close", killed)
        assert main(["monitor", *words, "--json", "--quiet"]) == INTERRUPTED
    early = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert kinds(early) == ["alarm"]
    expected = [json.loads(json.dumps(event).replace("all.csv", "rig.csv")) for event in expected]
    file.write_text(lines[0] + "".join(lines[215:] if rotated else lines[1:]))
    assert main(["monitor", *words, "--resume", "--json"]) == 0
    printed = capsys.readouterr()
    late = [json.loads(line) for line in printed.out.splitlines()]
    (last,) = [line for line in printed.err.splitlines() if line.startswith("resumed from ")]
    assert last.startswith("resumed from watch_2.mcap.partial at ")
    assert last.endswith(f" s; {len(early)} events already reported")
    assert early + late == expected
    logs = [path for path in (tmp_path / "logs").glob("*.mcap") if "_2" in path.name]
    assert [(m["t"], m["event"], m["message"]) for m in logged_events(logs[0])] == [
        (e["time"], e["kind"], e["text"]) for e in expected
    ]


def test_a_resumed_source_goes_on_after_the_logged_rows_and_notices() -> None:
    rows: list[Row] = [(float(k), [], []) for k in range(6)]
    logged: list[Row | str] = [rows[0], "row 2 is no row", rows[1], "delay", rows[2], "row 5 is no row"]
    file: list[Row | str] = [rows[0], "row 2 is no row", *rows[1:3], "row 5 is no row", rows[3], "late", *rows[4:]]
    later: list[Row | str] = [rows[3], "late", rows[4], rows[5]]
    assert list(resumed_items(logged, file)) == [*logged, *later]
    assert list(resumed_items(logged[:-1], file)) == [*logged, *later]
    assert list(resumed_items(logged, ["row 2 is no row", *rows[2:4], "late", *rows[4:]])) == [*logged, *later]
    behind: list[Row | str] = [*rows[4:], "the clock jumps", *rows[1:3]]  # the clock goes back later
    assert list(resumed_items(logged, [*rows[2:4], *behind])) == [*logged, rows[3], *behind]
    restarted: list[Row | str] = [(0.0, [], [1.0]), (1.0, [], [1.0])]  # the clock of a new file begins again
    assert list(resumed_items(logged, restarted)) == [*logged, *restarted]
    assert list(resumed_items(logged, [])) == logged


@pytest.mark.parametrize("size", [0.05, 0.0])
def test_neither_log_nor_replay_depends_on_how_many_rows_come_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], size: float
) -> None:
    """Among them unreadable rows, a repeated one, a hole, and a clock that jumps back, with and without a leak.

    All rows at once, each alone, and in two batches of which the first ends right after the part to learn from.
    """
    rows = [row(k if k < 280 else k - 20, levels) for k, levels in enumerate(readings(size))]
    rows[210:225] = []
    rows[170:170] = ["50,oops,50,1,2,3\n", rows[169], rows[170]]
    (tmp_path / "rig.csv").write_text(HEADER + rows[0] + "50,oops,50,1,2,3\n" + "".join(rows[1:]))
    hashes, logs = [], []
    for count in (LARGEST_BATCH, 151, 1):
        monkeypatch.setattr("fdi_torch.jobs.monitor.LiveBatches", lambda source, n=count: batched(source, n))
        folder = tmp_path / str(count)
        monitored(["--config", config(tmp_path), "--follow", "--idle", "0.1", "--out", str(folder)], capsys)
        logs += folder.glob("*.mcap")
        hashes.append(content_hash(read_run(logs[-1]).messages()))
    assert hashes[1] == hashes[0] and hashes[2] == hashes[0]
    assert main(["replay", str(logs[-1]), "--quiet"]) == 0
    assert capsys.readouterr().out.startswith("bit-equal")
    notices = [e["message"] for e in logged_events(logs[-1]) if e["event"] == "notice"]
    assert sum("oops" in str(text) for text in notices) == 2 and "jumps back" in str(notices)


def batched(source: Iterable[Row | str], count: int) -> Iterator[list[Row | str]]:
    """At most `count` items at once, as from `LiveBatches`."""
    items = iter(source)
    while batch := list(islice(items, count)):
        yield batch


def test_a_run_of_another_configuration_is_not_resumed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], watched: tuple[Path, list[dict[str, object]]]
) -> None:
    written(tmp_path / "rig.csv")
    assert left_unfinished(tmp_path, "watch") is None
    for name in ("watch.mcap.partial", "watcher.mcap.partial"):
        (tmp_path / name).write_bytes(b"part")
    assert left_unfinished(tmp_path, "watch") == tmp_path / "watch.mcap.partial"
    assert main(["monitor", "--config", config(tmp_path), "--resume", "--quiet"]) == 2
    assert "expected an unfinished log" in capsys.readouterr().err
    assert main(["monitor", "--config", config(watched[0]), "--resume", "--quiet"]) == 2
    assert "got a finished one; there is nothing to resume" in capsys.readouterr().err


def test_a_monitors_log_is_replayed_to_the_same_events(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], watched: tuple[Path, list[dict[str, object]]]
) -> None:
    [log] = (watched[0] / "logs").glob("*.mcap")
    assert main(["replay", str(log), "--quiet"]) == 0
    assert capsys.readouterr().out.startswith("bit-equal")
    with pytest.raises(ValueError, match="a key other than those of the data"):
        repeat_run(read_run(log), tmp_path / "again.mcap", ["recording.file=other.csv"])


def test_no_logged_mean_of_an_input_depends_on_where_the_recording_ends(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With each third sample kept, whichever of the three the last one is."""
    lines = [row(k, levels).replace(",50,", f",{45 + k % 7},", 1) for k, levels in enumerate(readings())]
    pumped = []
    for count in (SAMPLES, 230, 231, 232):
        (tmp_path / "rig.csv").write_text(HEADER + "".join(lines[:count]))
        thinned = {"recording": {"file": "rig.csv", "every": 3}, "output": {"folder": str(tmp_path / str(count))}}
        monitored(["--config", config(tmp_path, **thinned)], capsys)
        [log] = (tmp_path / str(count)).glob("*.mcap")
        pumped.append(series(read_run(log), "/plant/input")["Q1"].tolist())
    for early in pumped[1:]:
        assert early == pumped[0][: len(early)] and len(early) > 70


def test_a_fault_below_its_smallest_size_is_logged_and_not_said_aloud(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    written(tmp_path / "rig.csv")
    plant = {**plant_mapping(load_plant("three_tank")), "matters": {"T3.leak": {"smallest": "40 %", "urgency": "high"}}}
    assert main(["monitor", "--config", config(tmp_path, plant=plant), "--quiet"]) == 0
    said = capsys.readouterr().out
    assert "alarm " in said and "isolated " not in said.replace("alarm 1, isolated", "")
    assert said.splitlines()[-1] != "no alarm"
    [log] = (tmp_path / "logs").glob("*.mcap")
    assert [e["announced"] for e in logged_events(log) if e["event"] == "isolated"] == [False]
    loud = {**plant, "matters": {"T3.leak": {"urgency": "high"}}}
    events = monitored(["--config", config(tmp_path, plant=loud)], capsys)
    isolated = next(event for event in events if event["kind"] == "isolated")
    assert isolated["severity"] == "high" and "urgency: high" in str(isolated["text"])
