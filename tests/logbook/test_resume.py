"""An interrupted run continues, and its log equals that of an uninterrupted run."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path

import numpy as np
import pytest
from example_logs import FIXED, log_generation

from fdi_torch.jobs.train import state_is_due
from fdi_torch.logbook import LogError, Message, RunLog, content_hash, last_state, read_run, set_aside, unfinished


def search(log: RunLog, generations: range, population: np.ndarray) -> None:
    """A deterministic walk that logs its state every third generation."""
    for generation in generations:
        population = np.cos(population) + generation
        tested = {"h1_statistic": 2.0} if generation > 4 else {}
        log.write("/observer/residual", {"h1": generation, **tested}, float(generation))
        log_generation(log, generation, float(population.sum()), {"x": population[0]})
        if generation % 3 == 2:
            log.population(generation, {"population": population})


def until_state(messages: Iterator[Message], generation: int) -> Iterator[Message]:
    """Messages up to and with the state of a generation."""
    for message in messages:
        yield message
        if message.topic == "/estimator/de/population" and message.payload["generation"] == generation:
            return


def killed(path: Path, generations: int) -> None:
    """A run that leaves a partial file behind."""
    log = RunLog(path, "train", **FIXED).__enter__()
    search(log, range(generations), np.arange(3.0))
    log.flush()
    log._stop.set()
    log._open_sink().abandon()


@pytest.mark.parametrize("generations", [5, 8, 11])
def test_a_resumed_run_says_the_same(tmp_path: Path, generations: int) -> None:
    with RunLog(tmp_path / "whole.mcap", "train", **FIXED) as log:
        search(log, range(12), np.arange(3.0))
        log.say("done")
    killed(tmp_path / "a.mcap", generations)
    before = unfinished(tmp_path / "a.mcap")
    assert before is not None
    state = last_state(before)
    assert state is not None
    generation, arrays = state
    assert generation == generations // 3 * 3 - 1
    with RunLog(tmp_path / "a.mcap", "train", **FIXED) as log:
        kept = log.carry_over(until_state(before.messages(), generation))
        search(log, range(generation + 1, 12), arrays["population"])
        log.say("done")
    assert kept > generation
    whole, resumed = (read_run(tmp_path / name) for name in ("whole.mcap", "a.mcap"))
    assert content_hash(whole.messages()) == content_hash(resumed.messages())
    assert [m.sequence for m in whole.messages()] == [m.sequence for m in resumed.messages()]
    assert [m.channel for m in whole.messages()] == [m.channel for m in resumed.messages()]


def test_nothing_to_go_on_from(tmp_path: Path) -> None:
    assert set_aside(tmp_path / "a.mcap") is None and unfinished(tmp_path / "a.mcap") is None
    with RunLog(tmp_path / "a.mcap", "train", **FIXED) as log:
        log.say("nothing was searched")
    assert last_state(read_run(tmp_path / "a.mcap")) is None


def test_what_was_set_aside_stays(tmp_path: Path) -> None:
    for number in (1, 2):
        (tmp_path / "a.mcap.partial").write_bytes(bytes([number]))
        assert set_aside(tmp_path / "a.mcap") == tmp_path / f"a.mcap.partial.{number}"
    assert (tmp_path / "a.mcap.partial.1").read_bytes() == b"\x01"


def test_a_running_log_is_not_set_aside(tmp_path: Path) -> None:
    with RunLog(tmp_path / "a.mcap", "train", **FIXED):
        with pytest.raises(LogError, match="another run is writing this file; wait"):
            set_aside(tmp_path / "a.mcap")
        assert (tmp_path / "a.mcap.partial").exists()


def test_trials_done_are_carried_over(tmp_path: Path) -> None:
    with RunLog(tmp_path / "old.mcap", "study", **FIXED) as log:
        for trial in range(5):
            log.trial(trial, {"x": 1.0})
    old = read_run(tmp_path / "old.mcap")
    with RunLog(tmp_path / "new.mcap", "study", **FIXED) as log:
        log.carry_over(takewhile(lambda message: message.payload["trial"] < 3, old.messages()))
        log.trial(3, {"x": 1.0})
    assert [m.payload["trial"] for m in read_run(tmp_path / "new.mcap").messages()] == [0, 1, 2, 3]


def test_states_come_as_often_as_they_are_due() -> None:
    due = [generation for generation in range(5000) if state_is_due(generation)]
    assert due[:3] == [0, 32, 64] and due[-1] > 5000 * 7 / 8
