"""States of alarms; events depend only on the readings up to their time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from fdi_torch.config.plant_file import load_plant
from fdi_torch.monitor.alarm_state import FOLLOWS, Alarm, State
from fdi_torch.monitor.detection import CHARTS, make_detector
from fdi_torch.monitor.events import Event
from fdi_torch.monitor.hypothesis import Hypothesis, HypothesisFit
from fdi_torch.monitor.known_faults import end_recovered, possible_ends
from fdi_torch.monitor.monitor import Monitor, ResidualTrace
from fdi_torch.monitor.monitor_settings import MonitorSettings
from fdi_torch.monitor.monitor_setup import fault_free_part, prepare_monitor
from fdi_torch.monitor.monitor_state import DetectedChange, FaultTrack, HiddenFault, MonitorState
from fdi_torch.monitor.samples import ABSENT, ClockState, Samples, samples_of_recording, split_at_gaps
from fdi_torch.monitor.state_update import residuals_to_test
from fdi_torch.monitor.window_monitor import WindowMonitor
from fdi_torch.recording import Recording
from tests.test_monitor import SPACE, monitor, recorded


def test_an_alarm_allows_only_valid_transitions() -> None:
    alarm = Alarm(1, 10.0, 10.0)
    assert (
        alarm.with_state(State.ISOLATED).with_state(State.EXPLAINED).with_state(State.RECOVERED).state
        is State.RECOVERED
    )
    with pytest.raises(ValueError, match="a state that follows 'confirming', got 'watching'"):
        alarm.with_state(State.WATCHING)
    assert set(FOLLOWS) == set(State)
    again = alarm.raised_again(20.0)
    assert (again.first, again.last, again.count) == (10.0, 20.0, 2)


def troubled() -> Samples:
    """A leak that opens and closes, a bias that grows; gaps, repetitions, unknown inputs and missing readings, also
    right after a gap and where an input is known again. At last only each ninth sample is left.
    """

    def truth(time: float) -> Tensor:
        leak = 0.08 if 150.0 <= time < 330.0 else 0.0
        return SPACE.vector({"T1.leak.size": leak, "h3.sensor_bias.bias": 1e-4 * max(time - 520.0, 0.0)})

    samples = recorded(truth, 1600, seed=12)
    time, inputs, readings = samples.time.clone(), samples.inputs.clone(), samples.readings.clone()
    time[60] = time[59]
    time[440:] += 30.0
    inputs[455:459] = torch.nan
    readings[100:103, 1] = torch.nan
    readings[440:446, 0] = torch.nan
    readings[459:470, 2] = torch.nan
    rows = torch.cat([torch.arange(700), torch.arange(700, 1600, 9)])
    return replace(samples, time=time[rows], inputs=inputs[rows], readings=readings[rows])


Watch = Monitor | WindowMonitor


def in_pieces(watch: Watch, samples: Samples, cuts: Sequence[int]) -> tuple[list[Event], Tensor]:
    """Events, and residuals and statistic of each sample."""
    state, events, traces = watch.start(samples), [], []
    for first, last in zip([1, *cuts], [*cuts, len(samples)], strict=True):
        state, news = watch.advance(state, samples.segment(first, last), traces.append)
        events += news
    return events, columns(traces)


def columns(traces: Sequence[ResidualTrace]) -> Tensor:
    """Residuals and statistic of each sample, -1e9 where there are none."""
    return torch.cat([torch.cat([t.residual.nan_to_num(nan=-1e9), t.statistic[:, None]], dim=1) for t in traces])


Run = tuple[Watch, Samples, list[Event], Tensor]


@pytest.fixture(scope="module", params=["changes", "windows"])
def whole(request: pytest.FixtureRequest) -> Run:
    watch, samples = monitor(incipient=True), troubled()
    chosen = WindowMonitor(watch, "least_squares", 150.0, 70.0) if request.param == "windows" else watch
    return chosen, samples, *in_pieces(chosen, samples, [])


def test_events_and_residuals_are_identical_for_any_batching_of_samples(whole: Run) -> None:
    """All at once, and in batches that end at random."""
    watch, samples, events, trace = whole
    kinds = {event.kind for event in events}
    if isinstance(watch, Monitor):  # every state except learning occurs
        assert {"alarm", "isolated", "revised", "recovered", "notice"} <= kinds
    drawn = torch.randperm(len(samples) - 2, generator=torch.Generator().manual_seed(1))[:40] + 2
    again, same = in_pieces(watch, samples, sorted(drawn.tolist()))
    assert again == events and torch.equal(same, trace)


def test_no_event_depends_on_a_later_reading(whole: Run) -> None:
    """One sample at a time, of which each event is later than the one before: with the same events byte for byte."""
    watch, samples, expected, trace = whole
    state, events, traces = watch.start(samples), [], []
    for k in range(1, len(samples)):
        state, news = watch.advance(state, samples.segment(k, k + 1), traces.append)
        assert all(event.time > float(samples.time[k - 1]) for event in news)
        events += news
    assert events == expected and torch.equal(columns(traces), trace)


@pytest.mark.parametrize("cut", [158, 460])
def test_a_recording_that_ends_early_has_the_first_events_of_the_whole(cut: int, whole: Run) -> None:
    """Right after the onset of a fault, and right after inputs were unknown."""
    watch, samples, expected, trace = whole
    events, early = in_pieces(watch, samples.segment(0, cut), [])
    assert events == expected[: len(events)] and torch.equal(early, trace[: len(early)])
    assert all(event.time > float(samples.time[cut - 1]) for event in expected[len(events) :])


def test_after_a_gap_the_observer_waits_for_each_sensor_that_was_not_silent_for_long() -> None:
    time, readings = torch.arange(200.0), torch.arange(600.0).reshape(200, 3)
    readings[50:, 2] = torch.nan
    readings[121:123, 0] = torch.nan
    time[121:] += 20.0
    time[122:] += 20.0
    samples = Samples(time, torch.zeros(200, 2), readings)
    for first, unread, begins in ((1, 0, 49 + ABSENT), (50, 40, 123)):
        clock = ClockState(0.0, unread=torch.tensor([0, 0, unread]))
        [(before, _), (after, notice)], moved = split_at_gaps(clock, samples.segment(first, 200), 1.0)
        assert float(before.time[-1]) == 120.0 and moved.restart is None
        assert after.time[0] == time[begins] and after.readings[0, 0] == readings[begins, 0]
        assert notice == "; ".join(["no samples for 21 s; the observer restarts"] * 2)


@pytest.mark.parametrize("chart", CHARTS)
def test_a_statistic_updated_in_parts_equals_that_of_the_whole(chart: str) -> None:
    detector = make_detector(chart, 1000.0, 1.0, 3, torch.Generator().manual_seed(0))  # type: ignore[arg-type]
    white = torch.randn(700, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    white[50:53, 1] = torch.nan
    whole, _ = detector.update(white, None)
    parts, charted = [], None
    for first, last in ((0, 1), (1, 2), (2, 90), (90, 350), (350, 351), (351, 700)):
        part, charted = detector.update(white[first:last], charted)
        parts.append(part)
    assert torch.equal(torch.cat(parts), whole)
    assert torch.equal(detector.update(torch.stack([white, 0.0 * white]), None)[0][0], whole)


def test_a_misfit_that_has_passed_does_not_hide_a_change() -> None:
    """Beside a known fault, a residual counts relative to the `reach` residuals before it, not to older ones."""
    watch, reach = monitor(), 60
    white = torch.randn(500, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    white[100:140] += 100.0
    white[70:75, 2] = torch.nan
    white[400:, 0] += 3.0
    state = replace(watch.start(troubled()), tested=white, believed=SPACE.vector({"T1.leak.size": 0.1}))
    scaled = residuals_to_test(state, 499, reach)
    for k in (30, 90, 120, 150, 260, 450):
        before = white[max(k - reach, 0) : k].square().nanmean(dim=0).sqrt()
        assert torch.allclose(scaled[k - 1], white[k] / before.clamp(min=1.0), rtol=1e-12)
    assert torch.equal(residuals_to_test(state, 7, reach), scaled[-7:])
    statistic = watch.detector.update(scaled[259:], None)[0]
    first = int((statistic > watch.detector.threshold).to(torch.int8).argmax())
    assert 260 + first in range(400, 410)
    assert torch.equal(residuals_to_test(replace(state, believed=state.healthy), 499, reach)[100:], white[101:])


def test_on_a_slow_clock_as_many_residuals_are_kept_as_the_detector_compares_with() -> None:
    """The state keeps `longest` + `lookback` seconds, here 18 samples; the detector compares with 60 residuals."""
    watch, samples = monitor(lookback=60.0, longest=100.0), recorded(lambda t: SPACE.nominal(), 1800)
    rows, traces = torch.arange(0, 1800, 9), []
    slow = replace(samples, time=samples.time[rows], inputs=samples.inputs[rows], readings=samples.readings[rows])
    for chunk in (1, 199):
        state = watch.start(slow, SPACE.vector({"T1.leak.size": 0.1}), learning_until=1e9)
        parts: list[ResidualTrace] = []
        for first in range(1, 200, chunk):
            state, _ = watch.advance(state, slow.segment(first, first + chunk), parts.append)
        traces.append(torch.cat([part.statistic for part in parts]))
    assert torch.equal(*traces)


def drained(mouth: float, seconds: int, folder: Path, closes: int = 600, fills: int = 640) -> list[Event]:
    """The events of `drained_state`, with those of the end."""
    watch, state, events = drained_state(mouth, seconds, folder, closes, fills)
    return [*events, *watch.close(state)]


def drained_state(
    mouth: float, seconds: int, folder: Path, closes: int, fills: int
) -> tuple[Monitor, MonitorState, list[Event]]:
    """A monitor of two tanks: the drain of T opens at 400 s and closes, U leaks from 500 s on.

    A pump then fills T again. The drain's mouth (m) lies above the floor: water stays, and Torricelli's law
    does not hold.
    """
    (folder / "tank.yaml").write_text(
        "tanks: {T: {area: 100 cm^2, height: 60 cm}, U: {area: 100 cm^2, height: 60 cm}}\n"
        "pumps: {Q: {target: T, max_flow: 200 cm^3/s}, V: {target: U, max_flow: 200 cm^3/s}}\n"
        "pipes:\n"
        "  OUT: {source: T, area: 0.02 cm^2, discharge_coefficient: 0.8}\n"
        "  END: {source: U, area: 0.02 cm^2, discharge_coefficient: 0.8}\n"
        "sensors: {h: {tank: T}, k: {tank: U}}\n"
    )
    plant, outlet, rest = load_plant(folder / "tank.yaml"), 0.8 * 2e-6 * (2.0 * 9.81) ** 0.5, 0.3
    time, generator = torch.arange(seconds, dtype=torch.float64), torch.Generator().manual_seed(4)
    disturbed, noise = (s * torch.randn(800, 2, generator=generator, dtype=torch.float64) for s in (1e-4, 5e-4))
    kept = torch.full_like(time, outlet * rest**0.5)
    pumped = torch.stack([torch.where(time < 400.0, kept, torch.where(time < fills, 0.0, 2e-5)), kept], dim=1)
    levels = [torch.tensor([rest, rest], dtype=torch.float64)]
    for k in range(seconds - 1):
        level = levels[-1]
        for _ in range(20):
            drain = 60.0 * outlet * max(float(level[0]) - mouth, 0.0) ** 0.5 if 400 <= k < closes else 0.0
            leak = 0.5 * outlet * float(level[1]) ** 0.5 if k >= 500 else 0.0
            lost = outlet * level.sqrt() + torch.tensor([drain, leak])
            level = (level + 0.05 * (pumped[k] - lost) / 0.01).clamp(min=0.0)
        levels.append((level + disturbed[k]).clamp(min=0.0))
    readings, units = torch.stack(levels) + noise[:seconds], ("m^3/s",) * 2
    recording = Recording(time, pumped, readings, ("Q", "V"), ("h", "k"), units, ("m", "m"))
    settings = MonitorSettings(lookback=60.0, confirm=20.0, longest=400.0, incipient=False, together=1)
    free, wide = fault_free_part(recording, 0.0, 390.0), {"T.leak.size": (0.0, 100.0)}
    ready = prepare_monitor(plant, free, ["T.leak.size", "U.leak.size"], ranges=wide, settings=settings)
    samples = samples_of_recording(recording, plant)
    start = ready.monitor.start(samples, ready.believed, learning_until=390.0)
    return ready.monitor, *ready.monitor.advance(start, samples.segment(1, len(samples)))


def test_a_drain_is_not_told_as_closed_while_its_tank_is_dry(tmp_path: Path) -> None:
    events = drained(0.014, 600, tmp_path)
    assert [event.alarm for event in events if event.kind == "cannot tell"] == [1]
    assert not [event for event in events if event.kind == "recovered"]


@pytest.mark.parametrize("mouth", [0.014, 0.02])
def test_a_closed_drain_is_told_once_its_tank_fills_even_if_a_fault_came_between(mouth: float, tmp_path: Path) -> None:
    events = drained(mouth, 800, tmp_path)
    first, last = next(e for e in events if e.kind == "cannot tell"), next(e for e in events if e.kind == "recovered")
    assert first.time < 500.0 and 640.0 < last.time < 700.0
    assert (last.alarm, last.faults) == (1, ("T.leak.size",))
    assert last.onset is not None and last.onset_std is not None
    assert abs(last.onset - 600.0) < 2.0 * last.onset_std, "it closed while the tank was dry"
    assert any(e.faults == ("U.leak.size",) and 500.0 < e.time < 600.0 for e in events)
    assert [e.state for e in events if e.kind == "summary" and e.alarm == 1] == [State.RECOVERED]


def test_a_recovery_is_told_once_beside_a_fault_whose_end_the_readings_would_not_show() -> None:
    watch, samples = monitor(), recorded(lambda t: SPACE.nominal(), 40)
    leak, bias = SPACE.index("T1.leak.size"), SPACE.index("h3.sensor_bias.bias")
    size = 10.0, 0.1, 0.01
    tracks = [FaultTrack(c, 1, 5.0, 0.1, size, size, 1.0, 10.0) for c in (leak, bias)]
    hidden, none = HiddenFault(tracks[0], 0.1, 30.0, 39.0), torch.zeros(len(SPACE), dtype=torch.float64)
    fit = HypothesisFit(
        Hypothesis((leak, bias), recovered=(leak, bias)), SPACE.nominal(), none, 30.0, 0.5, 9.0, 1.0, 2.0, 3.0
    )
    change = DetectedChange(2, SPACE.nominal() + 0.1, 5.0, (fit,), 35.0, 99.0, tuple(tracks))
    sharp = dict.fromkeys((leak, bias))
    state = replace(
        watch.start(samples), hidden=(hidden,), alarms=(Alarm(1, 10.0, 10.0).with_state(State.CANNOT_TELL),)
    )
    state, events = end_recovered(watch.writer, state, change, [fit], sharp, tracks[:1])
    assert [(e.kind, e.alarm, e.state) for e in events] == [("recovered", 1, State.CANNOT_TELL)]
    assert events[0].text.startswith("sensor bias at h3: back to nominal, since 30.0")
    assert not end_recovered(watch.writer, state, change, [fit], sharp, tracks)[1], "both are told"
    shown, events = end_recovered(watch.writer, replace(state, hidden=()), change, [fit], sharp, tracks)
    assert shown.alarm(1).state is State.RECOVERED and [e.kind for e in events] == ["recovered"]


@pytest.mark.parametrize(("mouth", "closes"), [(0.0, 450), (0.0, 490), (0.014, 460)])
def test_the_end_of_a_drain_lies_within_the_time_in_which_its_dry_tank_does_not_show_it(
    mouth: float, closes: int, tmp_path: Path
) -> None:
    events = drained(mouth, 600, tmp_path, closes, closes + 10)
    last = next(e for e in events if e.kind == "recovered")
    assert last.onset is not None and last.onset_std is not None and last.onset_std < 40.0
    assert abs(last.onset - closes) <= 3.0**0.5 * last.onset_std + 1.0
    assert "back to nominal" in last.text and " between 4" in last.text and "inf" not in last.text


def test_another_fault_does_not_tell_when_a_drain_ended_in_a_dry_tank(tmp_path: Path) -> None:
    """The drain closes at 450 s and T fills from 515 s on. A leak of U since 500 s has a sharp onset."""
    watch, state, _ = drained_state(0.0, 535, tmp_path, 450, 515)
    drain, leak = (watch.observer.space.index(f"{tank}.leak.size") for tank in ("T", "U"))
    value, std = torch.zeros_like(state.believed), torch.zeros_like(state.believed)
    value[leak], std[leak] = 0.5, 0.05
    hypothesis = Hypothesis((drain, leak), recovered=(drain,))
    change = DetectedChange(
        2, state.believed, 400.0, (HypothesisFit(hypothesis, value, std, 500.0, 0.5, 9.0, 1.0, 2.0, 3.0),), 535.0, 999.0
    )
    (track,) = state.tracks
    assert track.column == drain
    ends = possible_ends(watch.observer, state, replace(change, ended=(track,)), 60.0)[drain]
    assert ends is not None and ends[0] < 450.0 and 510.0 < ends[1] < 520.0


def test_a_growing_fault_has_grown_since_its_latest_estimate() -> None:
    track = FaultTrack(0, 1, 0.0, 1.0, (100.0, 1.0, 0.03), (200.0, 2.0, 0.04), 1.0, 200.0)
    size, std = track.at(300.0)
    assert size == pytest.approx(3.0)
    assert std == pytest.approx(math.hypot(0.04, 0.05))
    assert track.at(200.0) == (2.0, 0.04)
    assert replace(track, last=(200.0, 1.01, 0.04)).at(300.0) == (1.01, 0.04), "no significant growth"
