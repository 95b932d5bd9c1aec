"""Logs of every format version remain readable."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

import numpy as np
import orjson
import pytest

from fdi_torch.cli import DONE, main
from fdi_torch.logbook import arrays, content_hash, inspect_log, last_state, own_signals, read_run, series, unpack
from fdi_torch.logbook.topic_definitions import TOPICS

TESTS = Path(__file__).parents[1]
FORMAT_1 = TESTS / "data/log_format_1.mcap"
FILE_SHA256 = "a3de1a9c2dc88e21bb76cccbf913e53bc97940ad099ddd1ef2a8894b0a6f6687"
CONTENT_HASH = "091835383d95f91e15527ac9b2043511a0fdd05585a89bec5194d7ab317aa312"
# Logs of whole commands, small ones: kind, and how the hashes of the file and of its contents begin.
COMMANDS = [
    ("train", "3be63431989f79ef", "e701dfee7b4401e0"),
    ("study", "8eaefe247aa0b1f9", "b4b4ba56d7656891"),
    ("gap", "f6aabf6a3d422db2", "602075beedd8c92d"),
    ("monitor", "89e8a937099d6f32", "3f2ec0ba2ff55757"),
    ("rehearsal", "787b29854bf52007", "64a16c5607bde079"),
    ("challenge", "2b4036dd6b4553c9", "d5f2cce268fb4001"),
]
# What one command wrote in other ways: name, kind, hashes. A fit window by window; a replay with another seed.
OTHER_WAYS = [
    ("windows", "train", "ec97452a9f695053", "86e9be987de96a9b"),
    ("what_if", "train", "eb514534738c4dc9", "dfa3e0fa705884bc"),
]
ADDED_LATER = {"/estimate/output", "/estimate/residual", "/source/clock"}


def test_format_1_is_the_file_it_was() -> None:
    assert hashlib.sha256(FORMAT_1.read_bytes()).hexdigest() == FILE_SHA256
    assert content_hash(read_run(FORMAT_1).messages()) == CONTENT_HASH


def test_format_1_means_what_it_meant() -> None:
    found = inspect_log(FORMAT_1)
    assert found.health.sound and found.messages == 115 and set(found.topics) == set(TOPICS) - ADDED_LATER
    assert found.about["run"]["format"] == "1" and found.about["seeds"] == {"noise": "7"}
    run = read_run(FORMAT_1)
    signals = own_signals(run)
    assert signals.output_names == ("h1", "h2", "h3") and signals.input_units == ("m^3/s", "m^3/s")
    assert signals.outputs[0].tolist() == [0.5012573022109339, 0.49867895136708695, 0.5064042265044328]
    assert np.argwhere(~signals.mask).tolist() == [[3, 1], [5, 0]] and np.isnan(signals.outputs[3, 1])
    assert series(run, "/estimator/de/generation")["best_cost"].tolist() == [1.0, 0.5, 1 / 3]
    (population,) = run.messages(["/estimator/de/population"])
    np.testing.assert_array_equal(unpack(population.payload)["cost"], [1, np.nan, 2, np.inf])
    (estimate,) = run.messages(["/estimate/final"])
    np.testing.assert_array_equal(estimate.payload["std"], [0.01, np.inf])
    (verdict,) = run.messages(["/gap/verdict"])
    assert orjson.loads(verdict.payload["answer"])["closure"]["closed_ci95"] == [0.99, 1.0]
    np.testing.assert_array_equal(arrays(run)["covariance"], np.eye(2))


@pytest.mark.parametrize(
    ("name", "kind", "file_hash", "content"), [*((kind, kind, *hashes) for kind, *hashes in COMMANDS), *OTHER_WAYS]
)
def test_each_commands_log_stays_readable(name: str, kind: str, file_hash: str, content: str, tmp_path: Path) -> None:
    path = TESTS / f"data/log_format_1_{name}.mcap"
    assert hashlib.sha256(path.read_bytes()).hexdigest().startswith(file_hash)
    run = read_run(path)
    assert content_hash(run.messages()).startswith(content)
    assert inspect_log(path).health.sound and run.metadata["fdi_torch.run"]["kind"] == kind
    assert main(["report", str(path), "--out", str(tmp_path / "page.html"), "--quiet"]) == DONE
    assert "<svg" in (tmp_path / "page.html").read_text()


def test_each_commands_log_means_what_it_meant() -> None:
    logs = {kind: read_run(TESTS / f"data/log_format_1_{kind}.mcap") for kind, *_ in COMMANDS}
    (estimate,) = logs["train"].messages(["/estimate/final"])
    assert estimate.payload["values"] == [0.3000623650791432] and estimate.payload["names"] == ["T1.leak.size"]
    assert last_state(logs["train"]) is not None
    assert [m.payload["trial"] for m in logs["study"].messages(["/study/trial"])] == [0, 1, 2, 3, 4]
    (verdict,) = logs["gap"].messages(["/gap/verdict"])
    assert (verdict.payload["verdict"], verdict.payload["causes"]) == ("ambiguous", ["leak@T1"])
    assert {m.payload["event"] for m in logs["monitor"].messages(["/observer/alarm"])} == {"notice"}
    pieces = [m.payload for m in logs["rehearsal"].messages(["/study/trial"])]
    assert [piece["group"].partition("/")[0] for piece in pieces] == [
        *["false alarms"] * 2, "faults found", "naming", "rivals"
    ]  # fmt: skip
    assert pieces[0]["expected"] == 0.12 and pieces[2]["fixed delay"] == [3.0, 4.0]
    answers = [m.payload for m in logs["challenge"].messages(["/study/trial"]) if m.payload["by"] == "fdi"]
    assert [(a["case"], a["status"], a["causes"]) for a in answers] == [
        ("case0001", "named", answers[0]["truth"]), ("case0002", "no_gap", [])
    ]  # fmt: skip


def test_what_a_command_wrote_in_other_ways_means_what_it_meant() -> None:
    windows, what_if = (read_run(TESTS / f"data/log_format_1_{name}.mcap") for name, *_ in OTHER_WAYS)
    (stretch,) = orjson.loads(windows.metadata["fdi_torch.result"]["stretches"])
    assert (stretch["name"], stretch["start"], stretch["stop"]) == ("T1.leak.size", 200.0, 400.0)
    assert stretch["size"] == 0.29947730352483615 and own_signals(windows).outputs.shape == (401, 3)
    parent = read_run(TESTS / "data/log_format_1_train.mcap").metadata["fdi_torch.run"]
    assert what_if.metadata["fdi_torch.run"]["parent_run_id"] == parent["run_id"]
    assert what_if.metadata["fdi_torch.seeds"] == {"seed": "5"}


def test_every_kind_of_log_that_is_written_has_a_golden_one() -> None:
    """The kinds as the code names them, where it opens a log."""
    jobs = "".join(path.read_text() for path in sorted((TESTS.parent / "fdi_torch/jobs").glob("*.py")))
    kinds = re.findall(r'RunLog\(\s*path,\s*"(\w+)"', jobs)
    assert jobs.count("RunLog(") == len(kinds) and set(kinds) == {kind for kind, *_ in COMMANDS}
