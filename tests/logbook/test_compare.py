"""Comparison of runs, and of a run with its replay."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pytest
from example_logs import FIXED, log_generation, write_everything, write_finished
from scipy import stats

from fdi_torch.logbook import Message, Run, RunLog, align, compare, read_run, replay
from fdi_torch.logbook.compare import chi2_p_value, labels_of
from fdi_torch.logbook.payload import pack

OTHER_DATA = [{"path": "rig.csv", "sha256": "cd" * 32}]


def write_run(path: Path, value: float, *, std: float = 0.01, generations: int = 3, **changes: Any) -> Path:
    with RunLog(path, "train", **{**FIXED, **changes}) as log:
        for generation in range(generations):
            for problem in range(2):
                log_generation(log, generation, 1 / (generation + 1) + problem, {"leak": value}, problem)
        log.estimate(["leak", "gain"], [value, 1.0], [std, 0.1], np.eye(2), "converged", units=["1", "m"])
    return path


def test_only_what_differs_is_told(tmp_path: Path) -> None:
    first = write_run(tmp_path / "a.mcap", 0.10)
    second = write_run(tmp_path / "b.mcap", 0.12, config={"plant": "three_tank", "steps": 3}, seeds={"noise": 8})
    found = compare([first, second])
    assert found.labels == ("a", "b") and found.same_data and not found.same_content
    assert found.differences["seeds"] == {"noise": ("7", "8")}
    assert found.differences["config"]["steps"] == ("", "3")
    assert "plant" not in found.differences["config"] and "env" not in found.differences
    assert "run" not in found.differences, "wall-clock fields are not compared"


def test_every_kind_of_run_shows_its_faults(tmp_path: Path) -> None:
    cause = {"effect": "leak", "location": "T1", "parameters": {"size": {"value": 0.31, "std": 0.02, "unit": "1"}}}
    with RunLog(tmp_path / "gap.mcap", "gap", **FIXED) as log:
        log.gap_verdict({"verdict": "named", "causes": [cause]})
    with RunLog(tmp_path / "monitor.mcap", "monitor", **FIXED) as log:
        for time, present, size in ((1.0, True, 0.5), (2.0, True, 0.3)):
            log.fault("leak.size", "T1", present, t=time, size=size, size_std=0.01, unit="1")
        log.fault("plugging.size", "P13", False, t=3.0, size=0.0, unit="1")
    [leak] = compare([tmp_path / "gap.mcap", tmp_path / "monitor.mcap"]).results
    assert (leak.name, leak.values, leak.std) == ("T1.leak.size", (0.31, 0.3), (0.02, 0.01))


def test_equal_runs_have_nothing_to_tell(tmp_path: Path) -> None:
    found = compare([write_finished(tmp_path / f"{name}.mcap") for name in "abc"])
    assert found.differences == {} and found.same_content
    assert len(found.labels) == 3 and found.rows()[0] == ["section", "key", "a", "b", "c", "unit", "p_value"]


@pytest.mark.parametrize(("other", "agree"), [(0.12, True), (0.15, False)])
def test_results_agree_within_their_errors(tmp_path: Path, other: float, agree: bool) -> None:
    found = compare([write_run(tmp_path / "a.mcap", 0.10), write_run(tmp_path / "b.mcap", other, data=OTHER_DATA)])
    leak, gain = found.results
    assert not found.shares_data and leak.apart == pytest.approx((other - 0.10) / 0.01)
    z = (other - 0.10) / math.hypot(0.01, 0.01)
    assert leak.p_value == pytest.approx(2 * stats.norm.sf(z), rel=1e-12) and leak.agree is agree
    assert gain.agree is True and gain.unit == "m"
    assert ["std", "leak", "0.01", "0.01", "1", ""] in found.rows()


def test_runs_on_one_recording_are_not_tested_as_if_their_errors_were_independent(tmp_path: Path) -> None:
    """Standard errors of estimates from the same noise do not add: the difference is given in the smaller of them."""
    a, b = write_run(tmp_path / "a.mcap", 0.10), write_run(tmp_path / "b.mcap", 0.12, std=0.02)
    found = compare([a, b])
    leak, gain = found.results
    assert found.same_data and found.shares_data and leak.agree is None and math.isnan(leak.p_value)
    assert leak.apart == pytest.approx(2.0) and gain.apart == 0.0
    third = compare([a, b, write_run(tmp_path / "c.mcap", 0.11, data=OTHER_DATA)])
    assert third.shares_data and not third.same_data and third.results[0].agree is None


def test_recordings_are_the_same_by_their_readings_not_by_the_name_of_their_file(tmp_path: Path) -> None:
    for name, level in (("a", 0.4), ("b", 0.4), ("c", 0.5)):
        with RunLog(tmp_path / f"{name}.mcap", "train", **{**FIXED, "data": []}) as log:
            time = np.arange(3.0)
            log.recording(time, np.zeros((3, 0)), np.full((3, 1), level), (), ("h",), (), ("m",))
            log.estimate(["leak"], [0.1], [0.01], np.eye(1), "converged", units=["1"])
    a, b, c = (tmp_path / f"{name}.mcap" for name in "abc")
    assert compare([a, b]).same_data and not compare([a, c]).shares_data


@pytest.mark.parametrize("runs", [2, 3, 4, 7, 12])
def test_the_p_value_is_that_of_chi_squared(runs: int) -> None:
    values, std = np.random.default_rng(runs).normal(1, 2, runs), np.linspace(1, 3, runs)
    q = np.sum((values - np.average(values, weights=std**-2)) ** 2 / std**2)
    assert chi2_p_value(values, std) == pytest.approx(stats.chi2.sf(q, runs - 1), rel=1e-12)


def test_the_test_of_agreement_holds_its_level() -> None:
    rng = np.random.default_rng(0)
    std = np.array([0.1, 0.5, 2.0])
    p_values = np.array([chi2_p_value(3 + std * rng.standard_normal(3), std) for _ in range(2000)])
    assert stats.kstest(p_values, "uniform").pvalue > 0.01


def test_agreement_is_not_claimed_without_errors(tmp_path: Path) -> None:
    found = compare([write_run(tmp_path / "a.mcap", 0.1, std=math.nan), write_run(tmp_path / "b.mcap", 0.2)])
    assert found.results[0].agree is None and math.isnan(chi2_p_value([1.0], [0.1]))
    assert [row[-1] for row in found.rows() if row[1] == "leak"] == ["", ""]


def test_curves_align_by_generation_not_by_time(tmp_path: Path) -> None:
    paths = [write_run(tmp_path / "a.mcap", 0.1, generations=2), write_run(tmp_path / "b.mcap", 0.1, generations=4)]
    axis, costs = align(paths, "/estimator/de/generation", "best_cost", {"problem": 1})
    np.testing.assert_array_equal(axis, [0, 1, 2, 3])
    np.testing.assert_array_equal(costs, [[2, 1.5, np.nan, np.nan], [2, 1.5, 1 + 1 / 3, 1.25]])


def test_of_several_messages_at_one_point_the_last_counts(tmp_path: Path) -> None:
    with RunLog(tmp_path / "a.mcap", "monitor", **FIXED) as log:
        for value in (1.0, 2.0):
            log.write("/observer/residual", {"h1": value}, 5.0)
    assert align([tmp_path / "a.mcap"], "/observer/residual", "h1")[1].tolist() == [[2.0]]


def test_residuals_align_by_plant_time(tmp_path: Path) -> None:
    for name, times in (("a", (0.0, 2.0)), ("b", (1.0, 2.0))):
        with RunLog(tmp_path / f"{name}.mcap", "monitor", **FIXED) as log:
            for t in times:
                log.write("/observer/residual", {"h1": t}, t)
    axis, values = align([tmp_path / "a.mcap", tmp_path / "b.mcap"], "/observer/residual", "h1")
    np.testing.assert_array_equal(axis, [0, 1, 2])
    np.testing.assert_array_equal(values, [[0, np.nan, 2], [np.nan, 1, 2]])


def test_one_log_is_nothing_to_compare(finished: Path) -> None:
    with pytest.raises(ValueError, match="expected at least two logs to compare, got 1"):
        compare([finished])


def test_labels_are_as_short_as_they_can_be(tmp_path: Path) -> None:
    assert labels_of([tmp_path / "x/a.mcap", tmp_path / "y/a.mcap"]) == ("x/a", "y/a")
    assert labels_of([tmp_path / "a.mcap", tmp_path / "a.mcap"]) == ("a#1", "a#2")


def test_a_replay_that_is_bit_equal(finished: Path, tmp_path: Path) -> None:
    def rerun(run: Run) -> Path:
        assert run.config_text == "plant: three_tank\n"
        with RunLog(tmp_path / "again.mcap", "replay", **FIXED) as log:
            write_everything(log)
            log.say("words are not compared")
        return log.path

    found = replay(finished, rerun, env={"python": "3.11"})
    assert found.outcome == "bit-equal" and found.first is None and found.largest == 0 and found.versions == {}
    assert found.events == sum(message.topic != "/log" for message in read_run(finished).messages())


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ValueError("no water"), None])
def test_the_replay_of_an_interrupted_run_may_go_on(tmp_path: Path, error: BaseException | None) -> None:
    """Its log lacks what the run had not computed yet; without a status, it was killed."""
    path = tmp_path / "a.mcap"
    with suppress(KeyboardInterrupt, ValueError), RunLog(path, "train", **FIXED) as log:
        log.alarm(1.0, "alarm", "h1")
        log.flush()
        if error is None:
            path = tmp_path / "killed.mcap"
            path.write_bytes(log.partial_path.read_bytes())
        else:
            raise error

    def onward(run: Run) -> list[Message]:
        [first] = run.messages()
        return [first, replace(first, log_time=first.log_time + 10**9)]

    found = replay(path, onward)
    assert (found.outcome, found.events) == ("bit-equal", 1)
    assert replay(path, lambda run: onward(run)[1:]).outcome == "differs"
    assert replay(path, lambda run: []).outcome == "differs"


def changed(run: Run, topic: str, **fields: Any) -> Iterator[Message]:
    """The logged messages, the last one on a topic with other fields."""
    last = [message.sequence for message in run.messages([topic])][-1]
    for message in run.messages():
        if message.topic == topic and message.sequence == last:
            message = replace(message, data=orjson.dumps({**orjson.loads(message.data), **fields}))
        yield message


def test_a_replay_within_tolerance(finished: Path) -> None:
    cost = 1 / 3 * (1 + 1e-12)
    found = replay(finished, lambda run: changed(run, "/estimator/de/generation", best_cost=cost))
    assert found.outcome == "within tolerance" and found.first is None
    assert found.first_inexact is not None and found.first_inexact.place == "generation 2"
    assert found.largest == pytest.approx(1e-12, rel=1e-3)
    assert "numpy" in found.versions and found.versions["python"][0] == "3.11"


@pytest.mark.parametrize(("deviation", "outcome"), [(5e-10, "within tolerance"), (2e-9, "differs")])
def test_the_tolerance_of_a_replay_is_relative(finished: Path, deviation: float, outcome: str) -> None:
    cost = 1 / 3 * (1 + deviation)
    found = replay(finished, lambda run: changed(run, "/estimator/de/generation", best_cost=cost))
    assert found.outcome == outcome


@pytest.mark.parametrize(
    ("topic", "fields", "field"),
    [
        ("/estimator/de/generation", {"best_cost": 0.3334}, "best_cost"),
        ("/estimate/final", {"status": "not_converged"}, "status"),
        ("/estimate/final", {"covariance": [1.0, 0.0, 0.0, 1.1]}, "covariance[3]"),
        ("/estimate/final", {"covariance": [1.0]}, "covariance"),
        ("/estimator/de/population", pack("cost", np.array([1.0, np.nan, 2.0, 3.0])), "cost[3]"),
        ("/diagnosis/fault", {"new": 1.0}, "new"),
        ("/estimator/refine/iteration", {"cost": "nan"}, "cost"),
    ],
)
def test_the_first_event_that_differs_is_named(finished: Path, topic: str, fields: dict[str, Any], field: str) -> None:
    found = replay(finished, lambda run: changed(run, topic, **fields))
    assert found.outcome == "differs" and found.first is not None
    assert (found.first.topic, found.first.field) == (topic, field)


def test_an_answer_logged_as_text_is_compared_by_its_numbers(tmp_path: Path) -> None:
    path = tmp_path / "gap.mcap"
    answer = {"verdict": "named", "posterior": [{"causes": [], "probability": 0.75}], "note": "[kept"}
    with RunLog(path, "gap", **FIXED) as log:
        log.gap_verdict(answer)

    def again(probability: float, note: str = "[kept") -> Any:
        told = {**answer, "posterior": [{"causes": [], "probability": probability}], "note": note}
        return replay(path, lambda run: changed(run, "/gap/verdict", answer=orjson.dumps(told).decode()))

    assert again(0.75).outcome == "bit-equal"
    assert again(0.75 * (1 + 1e-15)).outcome == "within tolerance"
    for found, field in ((again(0.7), "answer.posterior[0].probability"), (again(0.75, "[lost"), "answer.note")):
        assert found.outcome == "differs" and found.first is not None and found.first.field == field


def test_a_replay_that_stops_early_or_does_other_things(finished: Path) -> None:
    def shorter(run: Run) -> list[Message]:
        return list(run.messages())[:10]

    def other_order(run: Run) -> list[Message]:
        messages = list(run.messages())
        return [messages[1], messages[0], *messages[2:]]

    def later(run: Run) -> Iterator[Message]:
        return (replace(message, log_time=message.log_time + 10**9) for message in run.messages())

    for rerun, event, field in ((shorter, 11, "event"), (other_order, 1, "topic"), (later, 1, "log time")):
        found = replay(finished, rerun)
        assert found.first is not None and (found.first.event, found.first.field) == (event, field)
