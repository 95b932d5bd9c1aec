"""Rival explanations of an alarm: their order, and what the last line says of them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from fdi_torch.amounts import percent_text
from fdi_torch.monitor.events import SMALLEST_SHARE, Explanation, Size, headline
from tests.sessions import BLOCK, run_command
from tests.test_monitor import SPACE, followed, monitor, recorded, step_to

TUTORIAL = Path(__file__).parents[1] / "docs" / "tutorial.md"


@pytest.fixture(scope="module")
def rivals(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    """Events of the tutorial's rig and leak if the monitor has the nominal plant: three causes remain."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("rig"))
        for _, title, body in BLOCK.findall(TUTORIAL.read_text(encoding="utf-8")):
            if title:
                Path(title).write_text(body, encoding="utf-8")
        faults = "simulate.faults={Q.pump_lag: 8 s, A.leak: 0.2, A.leak.onset: 700 s}"
        changes = f"--set output.name=live --set simulate.duration='1000 s' --set '{faults}'"
        run_command(f"fdi simulate --config record.yaml --out . --seed 4 {changes}")
        lines = run_command("fdi monitor --config watch.yaml --set plant=rig.yaml --json --quiet")
    return [json.loads(line) for line in lines]


def test_explanations_are_named_likeliest_first(rivals: list[dict[str, Any]]) -> None:
    told = [event for event in rivals if len(event["explanations"]) > 1]
    first, *later, last = [event["kind"] for event in told]
    assert (first, {*later}, last) == ("explained", {"revised"}, "summary")
    for event in told:
        masses = [e["mass"] for e in event["explanations"]]
        assert masses == sorted(masses, reverse=True) and 0.95 <= sum(masses) <= 1.0 + 1e-9
        places = [event["headline"].index(percent_text(mass)) for mass in masses if mass >= SMALLEST_SHARE]
        assert len(places) == 3 and places == sorted(places)
        assert event["faults"] == ["A.leak.size"]


def test_the_summary_names_every_rival_and_the_error_of_its_onset(rivals: list[dict[str, Any]]) -> None:
    *_, last, summary = rivals
    assert (last["kind"], summary["kind"]) == ("revised", "summary")
    told = [
        [{"mass": e["mass"], **{s["name"]: s["size"] for s in e["sizes"]}} for e in x["explanations"]] for x in rivals
    ]
    assert told[-1] == told[-2]
    [raised] = [event["time"] for event in rivals if event["kind"] == "alarm"]
    since = f"since {summary['onset']:.1f} ± {summary['onset_std']:.2g} s"
    assert f"alarm 1, explained: {summary['headline']}, {since}; raised at {raised:g} s" == summary["text"]
    leak = summary["explanations"][0]["sizes"][0]
    assert f"{6e4 * leak['flow']:.3g} l/min now), " in summary["headline"], "at the levels at the end"
    assert summary["onset_std"] == last["onset_std"] > 0.0


def test_the_summary_of_a_growing_fault_has_its_size_at_the_end_and_its_growth() -> None:
    watch = monitor(lookback=60.0, confirm=20.0, incipient=True)
    state, events = followed(watch, recorded(lambda t: SPACE.vector({"T3.leak.size": 2e-4 * max(t - 150.0, 0.0)}), 420))
    [summary] = watch.close(state)
    last = [event for event in events if event.faults][-1]
    assert summary.growing and summary.onset_std == last.onset_std
    assert abs(summary.sizes[0] - 2e-4 * (summary.time - 150.0)) < 3.0 * summary.stds[0]
    assert last.time < summary.time and summary.sizes[0] > last.sizes[0] + 3.0 * last.stds[0]
    assert "leak at T3 (size 0.0" in summary.text and "; size changes by 0.7" in summary.text


def test_the_summary_of_a_fault_that_has_gone_names_it_without_a_size() -> None:
    watch = monitor()
    state, events = followed(watch, recorded(step_to("T3.leak.size", 0.05, 200.0, 400.0), 700))
    assert any(event.kind == "recovered" for event in events)
    summary = watch.close(state)[0]
    assert summary.text.startswith("alarm 1, recovered: leak at T3; raised ") and not summary.explanations


def test_a_headline_has_the_likeliest_and_every_rival_above_5_percent() -> None:
    names = ("A.leak.size", "Q.pump_gain.factor", "hA.sensor_bias.bias")
    shares = zip(names, (0.9, 0.06, 0.04), strict=True)
    told = [Explanation(mass, (Size(name, 0.1, 0.01, "1", "size 0.1"),)) for name, mass in shares]
    assert headline(told) == "leak at A (size 0.1), 90 %, or pump gain at Q (size 0.1), 6 %"
    assert headline(told, sizes=False) == "leak at A, 90 %, or pump gain at Q, 6 %"
    assert headline(told[2:]) == "sensor bias at hA (size 0.1)"


def test_a_headline_names_three_of_many_rivals() -> None:
    shares = (0.3, 0.2, 0.16, 0.14, 0.13, 0.04)
    told = [
        Explanation(mass, (Size(f"{k}.leak.size", 0.1, 0.01, "1", "size 0.1"),))
        for mass, k in zip(shares, "ABCDEF", strict=True)
    ]
    three = "leak at A, 30 %, or leak at B, 20 %, or leak at C, 16 %"
    assert headline(told, sizes=False) == f"{three}, or 2 more, 27 % (see the log)"
    assert headline(told[:3], sizes=False) == three


@pytest.mark.parametrize(
    ("flow", "shown"), [(9.6e-14, "0 cm^3/s now"), (-3e-13, "0 cm^3/s now"), (3e-9, "0.003 cm^3/s now")]
)
def test_an_empty_tank_has_no_leak_flow(flow: float, shown: str) -> None:
    """The law of an orifice is smoothed, so that some 1e-13 m^3/s remain."""
    assert Size("A.leak.size", 2.8, 0.1, "1", "size 2.80 ± 0.10", flow=flow).amounts[1] == shown


def test_the_summary_of_an_alarm_without_an_answer_says_only_that_it_is_not_explained() -> None:
    watch = monitor()
    state, _ = followed(watch, recorded(step_to("T3.leak.size", 0.05, 200.0), 300))
    [alarm, *_] = state.alarms
    change = SimpleNamespace(number=alarm.number, best=SimpleNamespace(misfit_ratio=2.0))
    event = watch.writer.summary(replace(state, change=change, tracks=()), replace(alarm, explanations=()))
    assert ": does not explain all of the residual; raised at" in event.text


def test_a_gap_in_the_fault_free_part_does_not_end_the_learning() -> None:
    watch, samples = monitor(), recorded(step_to("T3.leak.size", 0.1, 60.0), 200)
    time = samples.time.clone()
    time[100:] += 60.0
    start = watch.start(samples, learning_until=1000.0)
    state, events = watch.advance(start, replace(samples, time=time).segment(1, 200))
    assert [event.kind for event in events] == ["notice"] and state.learning_until == 1000.0
