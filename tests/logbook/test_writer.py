"""Writing of logs: the contents, whatever chunks they are written in."""

from __future__ import annotations

import subprocess
import sys
import time
from collections import Counter
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from types import ModuleType

import numpy as np
import orjson
import pytest
from example_logs import FIXED, VERDICT, log_generation, write_chunks
from mcap.reader import make_reader

from fdi_torch.logbook import RunLog, read_run
from fdi_torch.logbook.provenance import environment, git_state
from fdi_torch.logbook.sink import EPOCH_NS, log_time_of
from fdi_torch.logbook.topic_definitions import TOPICS


def test_the_reference_reader_finds_everything(finished: Path) -> None:
    with open(finished, "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        found = list(reader.iter_messages())
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        assert len(found) == summary.statistics.message_count == sum(1 for _ in read_run(finished).messages())
        assert {channel.topic for _, channel, _ in found} == set(TOPICS)
        assert all(message.log_time == message.publish_time for _, _, message in found)
        assert [item.name for item in reader.iter_attachments()] == ["config.yaml", "results.npz"]


def test_records_say_where_the_run_comes_from(finished: Path) -> None:
    run = read_run(finished)
    assert list(run.metadata) == [
        *(f"fdi_torch.{name}" for name in ("run", "config", "env", "git", "seeds", "data", "result", "status"))
    ]
    about = run.metadata["fdi_torch.run"]
    assert about["kind"] == "train" and about["started"] == "2026-09-21T14:13:20.123456789Z" and about["format"] == "1"
    assert run.metadata["fdi_torch.config"]["search.bounds"] == "[0.0,1.0]"
    assert run.metadata["fdi_torch.seeds"] == {"noise": "7"}
    assert run.metadata["fdi_torch.data"] == {"0.path": "rig.csv", "0.sha256": "ab" * 32}
    assert run.metadata["fdi_torch.result"] == {"estimate.T1.leak.size": "0.1"}
    assert run.metadata["fdi_torch.status"]["status"] == "completed"
    assert run.config_text == "plant: three_tank\n"
    assert run.complete and run.ours and run.advice == ""


def test_units_stand_in_the_channel(finished: Path) -> None:
    channels = {message.topic: dict(message.channel.metadata) for message in read_run(finished).messages()}
    assert channels["/plant/input"]["unit.Q1"] == "m^3/s" and channels["/plant/input"]["hold"] == "linear"
    assert channels["/plant/output"]["unit.h3"] == "m" and channels["/plant/output"]["unit.t"] == "s"
    assert channels["/diagnosis/fault"]["unit.flow"] == "m^3/s"
    assert channels["/study/trial"]["schema_version"] == "1"


def test_the_summary_counts_the_messages_of_all_chunks(tmp_path: Path) -> None:
    with open(write_chunks(tmp_path / "a.mcap"), "rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None and summary.statistics.chunk_count > 1
        found = Counter(channel.id for _, channel, _ in reader.iter_messages())
    assert summary.statistics.channel_message_counts == found


def test_a_log_time_is_the_nearest_nanosecond() -> None:
    times = [0.3 * k for k in range(1000)]
    assert [log_time_of(t) - EPOCH_NS for t in times] == [300_000_000 * k for k in range(1000)]


def test_waiting_messages_are_written_by_the_clock(tmp_path: Path) -> None:
    with RunLog(tmp_path / "a.mcap", "train", **FIXED, flush_seconds=0.02) as log:
        for generation in range(200):
            log_generation(log, generation, 1.0, {"x": 0.5})
            if generation == 150:
                time.sleep(0.1)
                assert len(list(read_run(tmp_path / "a.mcap.partial").messages())) == 151
        log.say("done")
    *generations, last = read_run(tmp_path / "a.mcap").messages()
    assert [m.payload["generation"] for m in generations] == list(range(200)) and last.topic == "/log"
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


@pytest.mark.parametrize("flushed", [(), (0,), (700, 2500, 4999)])
def test_chunks_end_anywhere_between_messages_and_attachments(tmp_path: Path, flushed: tuple[int, ...]) -> None:
    time_s = np.arange(2000.0)
    with RunLog(tmp_path / "a.mcap", "train", **FIXED) as log:
        log.samples("/plant/output", time_s, np.sin(time_s)[:, None], ["h1"], ["m"])
        for number in range(5000):
            log.trial(number, {"x": number**0.5})
            if number in flushed:
                log.flush()
            if number in (3, 3000):
                log.attach(f"{number}.txt", b"text")
                told = read_run(tmp_path / "a.mcap.partial").messages(["/study/trial"])
                assert [m.payload["trial"] for m in told] == list(range(number + 1))
    run = read_run(tmp_path / "a.mcap")
    assert run.complete and sum(1 for _ in run.messages()) == 7000
    assert [m.sequence for m in run.messages(["/study/trial"])] == list(range(5000))


def test_the_whole_verdict_is_kept(finished: Path) -> None:
    (message,) = read_run(finished).messages(["/gap/verdict"])
    payload = message.payload
    assert orjson.loads(payload["answer"]) == VERDICT
    assert payload["causes"] == ["pump_lag@Q1"] and payload["closed"] == 0.998


def test_the_kind_of_a_field_outlives_further_fields(tmp_path: Path) -> None:
    with RunLog(tmp_path / "a.mcap", "monitor", **FIXED) as log:
        log.alarm(0.0, "raised", "h1", cause="leak", sizes=[1.0], sure=True, count=2)
        log.alarm(0.0, "raised", "h1", size=float("nan"))
    schema = orjson.loads(list(read_run(tmp_path / "a.mcap").messages())[1].channel.schema_data)["properties"]
    kinds = {name: schema[name]["type"] for name in ("cause", "sizes", "sure", "count", "size")}
    assert kinds == {"cause": "string", "sizes": "array", "sure": "boolean", "count": "number", "size": "number"}


def test_further_fields_get_a_described_channel(tmp_path: Path) -> None:
    with RunLog(tmp_path / "a.mcap", "train", **FIXED) as log:
        log.write("/observer/residual", {"h1": 1.0}, 0.0)
        log.write("/observer/residual", {"h1": 1.0, "h1_statistic": 2.0}, 1.0)
        log.write("/observer/residual", {"h1": 1.0, "absent": None}, 2.0)
    channels = [message.channel for message in read_run(tmp_path / "a.mcap").messages()]
    assert b"h1_statistic" not in channels[0].schema_data
    assert b"h1_statistic" in channels[1].schema_data
    assert channels[1] == channels[2]


def test_a_status_can_be_set(tmp_path: Path) -> None:
    with RunLog(tmp_path / "a.mcap", "train", **FIXED) as log:
        log.set_status("not_converged", "600 generations were not enough")
    assert read_run(tmp_path / "a.mcap").metadata["fdi_torch.status"]["status"] == "not_converged"


def test_misuse_is_told(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"expected a log name that ends in \.mcap"):
        RunLog(tmp_path / "a.log", "train", **FIXED).__enter__()
    closed = RunLog(tmp_path / "a.mcap", "train", **FIXED)
    with pytest.raises(ValueError, match="outside its `with` block"):
        closed.say("hello")
    with RunLog(tmp_path / "a.mcap", "train", **FIXED) as log:
        with pytest.raises(ValueError, match="expected a finite time, got nan"):
            log.write("/study/trial", {"trial": 1}, float("nan"))
        with pytest.raises(ValueError, match=r"expected values of shape \(3, 1\), got \(2, 1\)"):
            log.samples("/plant/output", np.arange(3.0), np.zeros((2, 1)), ["h1"], ["m"])
        with pytest.raises(ValueError, match="expected a name other than t"):
            log.samples("/plant/output", np.arange(2.0), np.zeros((2, 1)), ["t"], ["m"])
        with pytest.raises(ValueError, match="expected finite times"):
            log.samples("/plant/output", np.array([0.0, np.nan]), np.zeros((2, 1)), ["h1"], ["m"])
        with pytest.raises(ValueError, match="expected the time as argument, got it among the fields"):
            log.trial(0, {"t": 1.0})
        for name in ("wall", "non_finite"):
            with pytest.raises(ValueError, match=f"expected a name other than non_finite and wall, got {name}"):
                log.trial(0, {name: 1.0})
        with pytest.raises(ValueError, match="/log: expected only timestamp"):
            log.write("/log", {"shout": 1.0})


def test_where_the_code_and_data_come_from(tmp_path: Path) -> None:
    versions = environment(("numpy", "no-such-package"))
    assert versions["numpy"] == np.__version__ and versions["no-such-package"] == "absent"
    assert git_state(tmp_path) == {"commit": "", "changed": ""}


def test_a_package_run_from_its_source_alone_has_no_version(monkeypatch: pytest.MonkeyPatch) -> None:
    def without_metadata(name: str) -> str:
        raise PackageNotFoundError(name)

    source_only = ModuleType("source_only")
    source_only.__getattr__ = without_metadata  # type: ignore[method-assign]
    monkeypatch.setitem(sys.modules, "source_only", source_only)
    assert environment(("source_only",))["source_only"] == "absent"


@pytest.mark.slow
def test_a_million_samples_in_little_memory_and_few_bytes(tmp_path: Path) -> None:
    samples = 1_000_000
    rng = np.random.default_rng(0)
    time_s, inputs, outputs = np.arange(samples) * 0.1, rng.random((samples, 2)), rng.standard_normal((samples, 3))
    with RunLog(tmp_path / "a.mcap", "simulate", **FIXED) as log:
        log.recording(time_s, inputs, outputs, ["a", "b"], ["x", "y", "z"], ["1"] * 2, ["m"] * 3)
    assert (tmp_path / "a.mcap").stat().st_size / (2 * samples) < 80


SPECIAL = [0.0, -0.0, 5e-324, 1e16, 1e-7, 123456789.0, 1 / 3, 1.7976931348623157e308, 1e21, 2.0**53]


def test_signals_keep_every_bit(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    numbers = rng.integers(-(2**63), 2**63 - 1, 6_000).view(np.float64)  # of every size: random bits
    numbers = np.concatenate([numbers[np.isfinite(numbers)][:4_990], SPECIAL]).reshape(1_000, 5)
    topics = ("/plant/input", "/plant/output")
    with RunLog(tmp_path / "a.mcap", "train", **FIXED) as log:
        log.recording(
            np.cumsum(rng.random(1_000)), numbers[:, :2], numbers[:, 2:], ["a", 'ü"{},'], ["x", "y", "z"], "11", "111"
        )
    read = (list(message.payload.values())[1:] for message in read_run(tmp_path / "a.mcap").messages(topics))
    assert np.array_equal(np.concatenate(list(read)).view(np.int64), numbers.ravel().view(np.int64))


def test_the_commit_and_whether_the_code_was_changed_since(tmp_path: Path) -> None:
    def git(*arguments: str) -> str:
        who = ("-c", "user.name=A", "-c", "user.email=a@b")
        done = subprocess.run(["git", "-C", tmp_path, *who, *arguments], capture_output=True, text=True, check=True)
        return done.stdout.strip()

    git("init")
    (tmp_path / "code.py").write_text("x = 1\n")
    git("add", "code.py")
    git("commit", "-m", "first")
    (tmp_path / "new.py").write_text("nobody knows it yet\n")
    assert git_state(tmp_path) == {"commit": git("rev-parse", "HEAD"), "changed": "no"}
    (tmp_path / "code.py").write_text("x = 22\n")
    assert git_state(tmp_path)["changed"] == "yes"
