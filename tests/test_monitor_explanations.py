"""Which explanations the monitor weighs, and in which order it names them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from fdi_torch.effects import build_network, place
from fdi_torch.monitor.explanations import Explainer
from fdi_torch.monitor.hypothesis import NO_CHANGE, Fault, Hypothesis, HypothesisFit, credible_set, merged
from fdi_torch.monitor.hypothesis_fit import Prior, fit
from fdi_torch.monitor.isolation import isolate, misfits_over_excess
from fdi_torch.monitor.monitor_state import DetectedChange, MonitorState
from fdi_torch.monitor.noise_model import learn_noise
from fdi_torch.monitor.observer_bank import ChangeHypotheses, ObserverBank
from fdi_torch.parameters import ParameterSpace
from tests.test_monitor import FAULTS, GROWTH_TIMES, PLANT, SPACE, STD, followed, from_rest, monitor, recorded, step_to


def explanation(column: int, misfit: float, probability: float) -> HypothesisFit:
    zeros = torch.zeros(5, dtype=torch.float64)
    return HypothesisFit(Hypothesis((column,)), zeros, zeros, 0.0, 1.0, 0.0, misfit, 1.0, 2.0, probability=probability)


def test_explanations_are_ranked_by_probability_and_none_is_told_without_those_that_no_reading_distinguishes() -> None:
    fits = [
        explanation(0, 10.5, 0.44),
        explanation(1, 10.0, 0.30),
        explanation(2, 10.0, 0.22),
        explanation(3, 14.0, 0.04),
    ]
    assert [f.hypothesis.columns[0] for f in merged(fits)] == [0, 1, 2, 3]
    assert [f.hypothesis.columns[0] for f in credible_set(merged(fits), 0.95)] == [0, 1, 2]
    assert [f.hypothesis.columns[0] for f in credible_set(merged(fits), 0.7)] == [0, 1, 2]
    assert [f.hypothesis.columns[0] for f in credible_set(merged(fits), 0.4)] == [0]


def test_every_fault_is_fitted_when_a_wrong_explanation_no_longer_holds() -> None:
    watch = monitor()
    state, _ = followed(watch, recorded(step_to("T3.leak.size", 0.05, 200.0), 320))
    assert state.change is not None
    window, before = state.window(100.0), state.change.before
    start = torch.cat([before, before.new_tensor([200.0])])[None]
    [wrong] = fit(watch.observer, window, before, [Hypothesis((3,))], start, 0.0, Prior(SPACE.names, 5))
    misled = replace(state, change=replace(state.change, explanations=(wrong,)))
    [event] = watch.alarms.on_threshold(misled)[1]
    assert event.kind in ("isolated", "revised") and event.faults == ("T3.leak.size",)


def test_no_explanation_has_more_simultaneous_faults_than_allowed_however_often_it_is_fitted_again() -> None:
    def truth(time: float) -> Tensor:
        return SPACE.vector(
            {"T1.leak.size": 0.05, "P13.plugging.size": 0.1, "h3.sensor_bias.bias": 0.01} if time > 100.0 else {}
        )

    bank, window = monitor().observer, from_rest(recorded(truth, 260))
    fits: list[HypothesisFit] = []
    for _ in range(2):
        fits = isolate(bank, window, SPACE.nominal(), FAULTS, deepest=2, earlier=fits)
        assert max(len(f.hypothesis.sizes) for f in fits) == 2


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ({}, {"T3.leak.size": 0.1, "P32.plugging.size": 0.2}),
        ({}, {"T2.leak.size": 0.1, "P32.plugging.size": 0.2}),
        ({"T3.leak.size": 0.1}, {"P32.plugging.size": 0.2}),
        ({"P32.plugging.size": 0.2}, {"T3.leak.size": 0.1}),
        ({"T1.leak.size": 0.1}, {"P13.plugging.size": 0.2}),
    ],
)
def test_two_changes_that_mask_each_other_are_among_the_explanations(
    before: dict[str, float], after: dict[str, float]
) -> None:
    """Two new faults, or one that recovers while another begins. A search that adds a second fault to the likeliest
    single changes misses them, because neither is among those.
    """
    tanks, pipes, sensors = ("T1", "T2", "T3"), ("P13", "P32", "OUT2"), ("h1", "h2", "h3")
    places = {
        "leak": tanks,
        "plugging": pipes,
        "pump_gain": ("Q1", "Q2"),
        "sensor_bias": sensors,
        "sensor_gain": sensors,
    }
    placed = [place(effect, at) for effect, each in places.items() for at in each]
    network = build_network(PLANT, placed)
    sizes = [f"{p.prefix}.{p.effect.parameters(p.location, PLANT)[0].name}" for p in placed]
    space = ParameterSpace([network.constants[name] for name in sizes])
    nominal, known, final = space.nominal(), space.vector(before), space.vector(after)
    learnt = learn_noise(network, recorded(lambda t: nominal, 400, network, space, seed=99), space, nominal)[0]
    window = from_rest(recorded(lambda t: final if t > 100.0 else known, 180, network, space, seed=1))
    bank = ObserverBank(network, space, learnt.gain, learnt.whitening)
    fits = isolate(bank, window, known, [Fault(c) for c in range(len(sizes))], GROWTH_TIMES, 2, nominal)
    columns, ended = ([sizes.index(name) for name in names] for names in (after, before))
    told = {(f.hypothesis.columns, f.hypothesis.recovered): f for f in credible_set(merged(fits))}
    found = told[tuple(sorted([*columns, *ended])), tuple(ended)]
    assert float(((found.value - final) / found.std)[columns].abs().max()) < 4.0


def test_exact_readings_later_on_give_no_weight_to_inexact_ones() -> None:
    """The noise is four times as large as learnt for 30 s, in which alone two onsets of the same bias differ."""
    bank, nominal = monitor().observer, SPACE.nominal()
    bias = step_to("h3.sensor_bias.bias", 0.02, 110.0)
    larger = 4.0 * STD * torch.randn(30, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    differences = []
    for count in (200, 800):
        samples = recorded(bias, count)
        samples.readings[100:130] += larger
        window = from_rest(samples)
        theta = bias(110.0).repeat(2, 1)
        lanes = ChangeHypotheses(theta, theta.new_tensor([109.5, 111.5]), torch.tensor([False, False]))
        misfits = 0.5 * bank.white_innovations(window, nominal, lanes).square().sum((1, 2))
        fits = [
            HypothesisFit(Hypothesis((4,)), theta[0], theta[0], onset, 1.0, 0.0, misfit, 3.0 * count, 3.0 * count)
            for onset, misfit in zip(lanes.onset.tolist(), misfits.tolist(), strict=True)
        ]
        right, late = misfits_over_excess(bank, window, nominal, fits, 60.0)
        differences.append((late - right) / float(misfits[1] - misfits[0]))
    assert differences[1] == pytest.approx(differences[0], rel=0.02) and differences[0] < 0.2


def test_a_fault_that_grew_before_the_search_window_is_found_with_its_onset() -> None:
    """Within the window alone, the growing fault starts at zero, and a sudden one is likelier."""

    def truth(time: float) -> Tensor:
        return SPACE.vector({"T3.leak.size": 2e-4 * max(time - 150.0, 0.0)})

    _, events = followed(monitor(lookback=40.0, confirm=20.0, incipient=True), recorded(truth, 240))
    first = next(e for e in events if e.faults)
    assert first.faults == ("T3.leak.size",) and first.growing
    assert abs(float(first.onset or 0.0) - 150.0) < 2.0 * float(first.onset_std or 0.0)
    assert abs(first.sizes[0] - 2e-4 * (first.time - 150.0)) < 3.0 * first.stds[0]


def test_a_fault_after_an_alarm_by_chance_is_told_as_soon_as_without_that_alarm() -> None:
    """An alarm that chance explains is fitted again for a whole longest window; the detector goes on meanwhile."""
    watch, run = monitor(lookback=60.0, confirm=20.0), recorded(step_to("T3.leak.size", 0.05, 300.0), 360)
    readings = run.readings.clone()
    readings[200:203, 0] += 6.0 * STD
    _, events = followed(watch, replace(run, readings=readings))
    kinds = [(e.kind, e.alarm) for e in events]
    assert kinds[:2] == [("alarm", 1), ("cannot tell", 1)] and events[0].time < 210.0
    assert ("retired", 1) in kinds and ("isolated", 2) in kinds
    told = next(e for e in events if e.faults)
    assert told.faults == ("T3.leak.size",) and told.time < 340.0


def test_a_change_that_turns_out_to_be_chance_is_withdrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """It raised an IndexError: no explanation with a parameter was left."""
    watch, run = monitor(lookback=60.0, confirm=20.0), recorded(step_to("T3.leak.size", 0.05, 300.0), 420)
    state, _ = followed(watch, run.segment(0, 340))
    assert state.change is not None and bool(state.off_nominal.any())

    def by_chance(self: Explainer, state: MonitorState, change: DetectedChange) -> list[HypothesisFit]:
        return [replace(change.best, hypothesis=NO_CHANGE, misfit=0.0)]

    monkeypatch.setattr(Explainer, "of_change", by_chance)
    state, events = watch.advance(state, run.segment(340, 380))
    told = next(e for e in events if e.kind == "cannot tell")
    assert told.alarm == 1 and "chance" in told.text and not told.believed
    assert not state.tracks and not bool(state.off_nominal.any())


def test_no_onset_lies_in_the_part_that_is_declared_fault_free() -> None:
    """The flows are learnt from that part and the window, so that they must not overlap either."""
    watch = monitor(lookback=100.0, confirm=20.0, incipient=True)
    samples = recorded(lambda t: SPACE.vector({"T3.leak.size": 2e-4 * max(t - 150.0, 0.0)}), 260)
    state = watch.start(samples, learning_until=200.0)
    state, events = watch.advance(state, samples.segment(1, 260))
    told = [e.onset for e in events if e.faults]
    assert told and all(onset is not None and onset >= 199.0 for onset in told)


def test_misfits_of_two_isolations_of_one_window_are_those_of_the_same_noise() -> None:
    """Known faults and new ones are fitted apart, and their misfits compared."""
    watch, nominal = monitor(), SPACE.nominal()
    window = from_rest(recorded(step_to("T3.leak.size", 0.05, 60.0), 140))
    for faults in (FAULTS[1:2], FAULTS[2:]):
        best = isolate(watch.observer, window, nominal, faults, deepest=1)[0]
        assert best.fits == (faults == FAULTS[1:2])
        onset = torch.tensor([best.onset], dtype=torch.float64)
        lane = ChangeHypotheses(best.value[None], onset, torch.tensor([best.hypothesis.incipient]))
        white = watch.observer.white_innovations(window, nominal, lane)
        assert abs(0.5 * float(white.square().sum()) - best.misfit) < 1e-9 * best.misfit
