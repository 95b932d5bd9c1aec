"""The monitor on simulated changes of known size and onset, with irregular clocks, and on a real leak."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import pytest
import torch
from rigs import blank_recording, whitening_of
from torch import Tensor

from fdi_torch.cli import main
from fdi_torch.config.loaded_recordings import read_recording
from fdi_torch.config.monitor_file import load_monitor
from fdi_torch.config.plant_file import load_plant
from fdi_torch.effects import build_network, place
from fdi_torch.effects.usual_faults import usual_faults
from fdi_torch.estimate.uncertainty import end_reached
from fdi_torch.jobs.logged_monitor import MonitorCallbacks
from fdi_torch.jobs.monitor import run_monitor
from fdi_torch.monitor.alarm_state import State
from fdi_torch.monitor.detection import make_detector
from fdi_torch.monitor.events import Event
from fdi_torch.monitor.fault_free_checks import learning_times, residual_warnings
from fdi_torch.monitor.hypothesis import Fault, Hypothesis, faults_of
from fdi_torch.monitor.hypothesis_fit import Prior, fit
from fdi_torch.monitor.isolation import isolate
from fdi_torch.monitor.law_errors import ConstantErrors, prior_std
from fdi_torch.monitor.level_forecast import DRAWS, limit_of
from fdi_torch.monitor.monitor import Monitor
from fdi_torch.monitor.monitor_settings import MonitorSettings
from fdi_torch.monitor.monitor_setup import fault_free_part, prepare_monitor
from fdi_torch.monitor.monitor_state import FaultTrack, HiddenFault, MonitorState
from fdi_torch.monitor.noise_model import NoiseModel, learn_noise
from fdi_torch.monitor.observer import Observation
from fdi_torch.monitor.observer_bank import ChangeHypotheses, ObserverBank, ObserverWindow, no_change
from fdi_torch.monitor.observer_gain import hand_gain
from fdi_torch.monitor.samples import (
    ClockState,
    Samples,
    mean_interval,
    samples_of_recording,
    split_at_gaps,
    usual_interval,
)
from fdi_torch.monitor.whitening import Whitening
from fdi_torch.parameters import ParameterName, ParameterSpace
from fdi_torch.plant.network import TankNetwork
from fdi_torch.recording import Recording
from fdi_torch.simulate.compiled_engine import CompiledEngine
from fdi_torch.simulate.equilibrium import equilibrium
from fdi_torch.simulate.experiment import lay_out

PLANT = load_plant("three_tank")
PLACES = [("leak", "T1"), ("leak", "T3"), ("plugging", "P13"), ("pump_gain", "Q2"), ("sensor_bias", "h3")]
NETWORK = build_network(PLANT, [place(*p) for p in PLACES])
NAMES = ["T1.leak.size", "T3.leak.size", "P13.plugging.size", "Q2.pump_gain.factor", "h3.sensor_bias.bias"]
SPACE = ParameterSpace([NETWORK.constants[name] for name in NAMES])
FAULTS = [Fault(column) for column in range(5)]
INPUTS = torch.tensor([50e-6, 50e-6], dtype=torch.float64)
REST = equilibrium(NETWORK, INPUTS)
STD = 1e-3
GROWTH_TIMES = (100.0, 10_000.0)  # s
Truth = Callable[[float], Tensor]


def constant_parts(truth: Truth, samples: int) -> Iterator[tuple[Tensor, int, int]]:
    """Parameters, first sample and the one after the last, of parts with constant parameters; the first sample has
    those of the step after it.
    """
    first, theta = 0, truth(0.5)
    for k in range(2, samples):
        if not torch.equal(following := truth(k - 0.5), theta):
            yield theta, first, k
            first, theta = k, following
    yield theta, first, samples


def recorded(
    truth: Truth,
    samples: int,
    network: TankNetwork = NETWORK,
    space: ParameterSpace = SPACE,
    std: Tensor | float = STD,
    seed: int = 0,
    inputs: Tensor = INPUTS,
) -> Samples:
    """One run whose parameters follow `truth` (s -> values of the space). inputs: (2,) or (samples, 2)."""
    inputs = inputs.expand(samples, 2)
    starts = [f"{tank.name}.start_level" for tank in PLANT.tanks]
    whole = ParameterSpace(network.constants[name] for name in [*space.names, *starts])
    levels, clean = REST, torch.empty(samples, 3, dtype=torch.float64)
    for theta, first, last in constant_parts(truth, samples):
        begin = max(first - 1, 0)
        time = torch.arange(begin, last, dtype=torch.float64)
        experiment = lay_out(blank_recording(PLANT, inputs[begin:last], time), PLANT.channels(), 1.0)
        engine, values = CompiledEngine(network, whole, experiment), torch.cat([theta, levels])
        clean[first:last] = engine.readings(values)[first - last :]
        levels = engine.levels(values)[-1]
    generator = torch.Generator().manual_seed(seed)
    noisy = clean + std * torch.randn(clean.shape, generator=generator, dtype=torch.float64)
    return Samples(torch.arange(samples, dtype=torch.float64), inputs, noisy)


def from_rest(samples: Samples) -> ObserverWindow:
    """All of a run whose levels at its first sample are known, the observer settled."""
    return ObserverWindow(samples, REST, 10**6)


def step_to(name: str, size: float, at: float, until: float = 1e9) -> Truth:
    def truth(time: float) -> Tensor:
        return SPACE.vector({name: size} if at <= time < until else {})

    return truth


@lru_cache
def fault_free() -> Samples:
    return recorded(lambda t: SPACE.nominal(), 600, seed=99)


@lru_cache
def noise() -> NoiseModel:
    return learn_noise(NETWORK, fault_free(), SPACE, SPACE.nominal())[0]


def monitor(**settings: float) -> Monitor:
    detector = make_detector("cusum", 20000.0, 1.0, 3, torch.Generator().manual_seed(0))
    chosen = {"lookback": 120.0, "confirm": 40.0, "longest": 400.0, "incipient": False, "together": 1} | settings
    return Monitor(NETWORK, SPACE, noise(), detector, MonitorSettings(**chosen))  # type: ignore[arg-type]


def followed(run_monitor: Monitor, samples: Samples, chunk: int = 20) -> tuple[MonitorState, list[Event]]:
    state, events = run_monitor.start(samples), []
    for first in range(1, len(samples), chunk):
        state, news = run_monitor.advance(state, samples.segment(first, min(first + chunk, len(samples))))
        events += news
    return state, events


@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("T3.leak.size", 0.05),
        ("Q2.pump_gain.factor", 0.9),
        ("h3.sensor_bias.bias", 4e-3),
    ],
)
def test_a_fault_is_detected_isolated_and_sized_with_its_onset(name: str, size: float) -> None:
    _, events = followed(monitor(), recorded(step_to(name, size, 200.0), 320))
    assert [event.kind for event in events][:2] == ["alarm", "isolated"]
    assert 200.0 <= events[0].time < 240.0
    found = events[1]
    assert found.faults == (name,)
    assert found.onset is not None and found.onset_std is not None
    assert abs(found.sizes[0] - size) < 4 * found.stds[0]
    assert abs(found.onset - 199.5) < 0.5 + 4 * found.onset_std


def test_a_leak_is_told_with_the_flow_that_it_has_now() -> None:
    """0.05 times C_d A sqrt(2 g h) of pipe P13, to which a leak of T3 refers."""
    samples = recorded(step_to("T3.leak.size", 0.05, 200.0), 320)
    state, events = followed(monitor(), samples)
    pipe = next(pipe for pipe in PLANT.pipes if pipe.name == "P13")
    full = pipe.discharge_coefficient * pipe.area * (2.0 * PLANT.gravity) ** 0.5
    found = next(event for event in events if event.kind == "isolated")
    level = float(samples.readings[int(found.time) - 5 : int(found.time) + 5, 2].mean())
    [size] = found.explanations[0].sizes
    assert size.flow == pytest.approx(size.size * full * level**0.5, rel=2e-3)
    assert f", {1e6 * size.flow:.3g} cm^3/s now), since" in found.text
    assert found.to_dict()["explanations"][0]["sizes"][0]["flow"] == size.flow
    [summary] = monitor().close(state)
    assert " cm^3/s now)" in summary.text


@pytest.mark.parametrize("period", [(1, 2, 1), (1, 1, 10)])
def test_sensors_may_have_different_rates_and_never_be_read_together(period: tuple[int, ...]) -> None:
    """Half the readings: standard errors are larger by their square root, no more and no less."""

    def thinned(samples: Samples) -> Samples:
        row = torch.arange(len(samples))
        read = torch.stack([row % 2 == k % 2 for k in period], dim=1)
        if max(period) > 2:
            read = torch.stack([row % k == 0 for k in period], dim=1)
        return replace(samples, readings=torch.where(read, samples.readings, torch.nan))

    run = recorded(step_to("T3.leak.size", 0.05, 300.0), 500, seed=3)
    learnt = learn_noise(NETWORK, thinned(fault_free()), SPACE, SPACE.nominal())[0]
    whole, rare = monitor(), replace_noise(monitor(), learnt)
    assert learnt.whitening.order == 0
    assert learnt.reading_std.tolist() == pytest.approx([STD] * 3, rel=0.15)
    found = [[e for e in followed(m, s)[1] if e.kind == "isolated"] for m, s in ((whole, run), (rare, thinned(run)))]
    assert [[e.faults for e in events] for events in found] == [[("T3.leak.size",)]] * 2
    first, second = (events[0] for events in found)
    assert abs(second.sizes[0] - 0.05) < 3.0 * second.stds[0]
    assert abs(second.onset - 300.0) < 3.0 * second.onset_std
    assert 1.0 < second.stds[0] / first.stds[0] < 2.2


def replace_noise(run_monitor: Monitor, learnt: NoiseModel) -> Monitor:
    return Monitor(run_monitor.network, run_monitor.space, learnt, run_monitor.detector, run_monitor.settings)


def test_random_sample_times_are_not_gaps() -> None:
    gaps = torch.empty(3000, dtype=torch.float64).exponential_(generator=torch.Generator().manual_seed(1))
    samples = Samples(torch.cumsum(gaps, 0), INPUTS.expand(3000, 2), REST.expand(3000, 3))
    assert float(gaps.max()) > 10.0 * float(gaps.median())
    stretches, arrived = split_at_gaps(
        ClockState(float(samples.time[0])), samples.segment(1, 3000), usual_interval(samples.time)
    )
    assert [notice for _, notice in stretches] == [""] and arrived.last == float(samples.time[-1])


def test_a_detector_counts_the_time_between_false_alarms_also_where_rows_are_missing() -> None:
    """45 % of the rows are missing: most intervals are 1 s, their mean is 1.8 s."""
    whole = recorded(lambda t: SPACE.nominal(), 3000, seed=99)
    kept = torch.rand(3000, generator=torch.Generator().manual_seed(2)) < 0.55
    part = PLANT.recording(whole.time[kept], whole.inputs[kept], whole.readings[kept], hold=whole.hold, source="rig")
    prepared = prepare_monitor(PLANT, part, NAMES, time_between_false_alarms=2000.0)
    design, mean = prepared.monitor.detector.design, float(torch.diff(part.time).mean())
    assert design.run_length * mean == pytest.approx(2000.0)
    assert learning_times(prepared.monitor.noise, prepared.monitor.detector)[0] == pytest.approx(3000.0, rel=0.01)
    flows = prepared.monitor.noise.whitening.flows
    assert flows is not None and flows.interval == pytest.approx(mean)
    gap = torch.tensor([0.0, 1.0, 1.0, 3.0, 503.0, 505.0], dtype=torch.float64)
    assert mean_interval(gap) == pytest.approx(5.0 / 3.0)


def test_a_fault_that_ends_is_reported_as_recovered() -> None:
    _, events = followed(monitor(), recorded(step_to("T1.leak.size", 0.1, 150.0, 330.0), 460))
    kinds = [event.kind for event in events]
    assert kinds[:2] == ["alarm", "isolated"] and kinds.count("alarm") == 2
    last = next(event for event in events if event.kind == "recovered")
    assert last.faults == ("T1.leak.size",) and last.onset is not None and abs(last.onset - 329.5) < 3.0


@pytest.mark.parametrize(
    ("name", "truth"),
    [
        ("T1.leak.size", step_to("T1.leak.size", 1.6, 200.0)),
        ("Q2.pump_gain.factor", step_to("Q2.pump_gain.factor", 2.5, 200.0)),
        ("Q2.pump_gain.factor", lambda t: SPACE.vector({"Q2.pump_gain.factor": 1.0 + 0.003 * max(t - 200.0, 0.0)})),
    ],
)
def test_a_size_beyond_its_range_is_told_as_at_least_its_end_and_causes_no_other_fault(name: str, truth: Truth) -> None:
    watch = monitor(longest=200.0, incipient=True)
    state, events = followed(watch, recorded(truth, 700), 100)
    events += watch.close(state)
    end = SPACE[name].high
    ended = [e for e in events if e.best is not None and e.best.sizes[0].at_end]
    assert ended and {e.faults for e in events if e.faults} == {(name,)}
    assert all(f"{ParameterName.parse(name).field} at least {end:g}, the end of its range" in e.text for e in ended)
    assert {(e.sizes, e.stds) for e in ended} == {((end,), (float("inf"),))}
    assert [e.sizes for e in events if e.kind == "summary" and e.sizes] == [(end,)]
    assert {e.state for e in ended} == {State.CANNOT_TELL} and sum(e.kind == "alarm" for e in events) == 1
    assert all(abs(e.onset - 200.0) <= 3.0 * e.onset_std for e in ended if e.onset is not None and e.onset_std)


def test_a_fault_with_an_inexact_law_is_one_event_until_it_ends() -> None:
    """A hole 25 cm above the floor, modelled as a hole in the floor: its estimated size decreases."""
    space = ParameterSpace([NETWORK.constants["T1.leak.size"], NETWORK.constants["T1.leak.height"]])

    def truth(time: float) -> Tensor:
        return space.vector({"T1.leak.size": 0.3, "T1.leak.height": 0.25} if 200.0 <= time < 700.0 else {})

    _, events = followed(monitor(), recorded(truth, 800, NETWORK, space), 50)
    alarms = [event.time for event in events if event.kind == "alarm"]
    assert len(alarms) == 2 and alarms[0] < 210.0 and 700.0 <= alarms[1] < 720.0
    assert all(event.faults == ("T1.leak.size",) for event in events if event.kind not in ("alarm", "retired"))
    last = next(event for event in events if event.kind == "recovered")
    assert last.sizes == (0.0,) and last.onset is not None
    assert abs(last.onset - 699.5) < 3.0


def test_an_incipient_fault_is_distinguished_from_a_sudden_one() -> None:
    def truth(time: float) -> Tensor:
        return SPACE.vector({"h3.sensor_bias.bias": 1e-4 * max(time - 100.0, 0.0)})

    samples = recorded(truth, 260)
    run_monitor = ObserverBank(NETWORK, SPACE, noise().gain, noise().whitening)
    best = isolate(run_monitor, from_rest(samples), SPACE.nominal(), FAULTS, GROWTH_TIMES, deepest=1)[0]
    assert best.hypothesis.columns == (4,) and best.hypothesis.incipient
    assert float(best.value[4]) == pytest.approx(1e-4 * 159.0, rel=0.05)
    assert abs(best.onset - 100.0) < 10.0


@pytest.mark.parametrize("rate", [1e-4, -3e-4])
def test_the_evidence_of_a_growing_fault_is_the_integral_over_its_onset_and_the_time_it_grows_for(rate: float) -> None:
    """Against sums over a grid. A time to pass through the range in either direction is log-uniform; the onset is
    uniform.
    """

    def truth(time: float) -> Tensor:
        return SPACE.vector({"h3.sensor_bias.bias": rate * max(time - 100.0, 0.0)})

    observer, window = ObserverBank(NETWORK, SPACE, noise().gain, noise().whitening), from_rest(recorded(truth, 200))
    nominal, hypothesis, prior = SPACE.nominal(), Hypothesis((4,), True), Prior(SPACE.names, 1, GROWTH_TIMES)
    high = SPACE.parameters[4].high
    start = torch.cat([nominal, nominal.new_tensor([100.0])])[None]
    start[0, 4] = 99.0 * rate
    [fitted] = fit(observer, window, nominal, [hypothesis], start, 0.0, prior)

    onsets = torch.linspace(fitted.onset - 4.0 * fitted.onset_std, fitted.onset + 4.0 * fitted.onset_std, 81)
    times = high / abs(rate) * torch.linspace(-0.7, 0.7, 161, dtype=torch.float64).exp()
    onset, time = torch.meshgrid(onsets.to(times), times, indexing="ij")
    theta = nominal.repeat(onset.numel(), 1)
    theta[:, 4] = (math.copysign(high, rate) * (199.0 - onset) / time).flatten()
    changes = ChangeHypotheses(theta, onset.flatten(), torch.ones(onset.numel(), dtype=torch.bool))
    cost = 0.5 * observer.white_innovations(window, nominal, changes).square().sum((1, 2)).reshape(onset.shape)
    lowest = float(cost.min())
    density = torch.exp(lowest - cost) / 199.0 / (2.0 * math.log(GROWTH_TIMES[1] / GROWTH_TIMES[0]))
    integral = torch.trapezoid(torch.trapezoid(density, times.log()), onsets.to(times))
    assert fitted.evidence - prior(hypothesis) == pytest.approx(float(integral.log()) - lowest, abs=0.1)


def test_a_growing_fault_that_no_reading_shows_is_not_likelier_than_before() -> None:
    """The gain of a pump at rest, with an onset at any time."""
    samples = recorded(lambda t: SPACE.nominal(), 200, inputs=INPUTS * torch.tensor([1.0, 0.0]))
    observer, nominal = ObserverBank(NETWORK, SPACE, noise().gain, noise().whitening), SPACE.nominal()
    hypothesis, prior = Hypothesis((3,), True), Prior(SPACE.names, 1, GROWTH_TIMES)
    starts = torch.cat([nominal.repeat(3, 1), nominal.new_tensor([[5.0], [100.0], [197.0]])], dim=1)
    for fitted in fit(observer, from_rest(samples), nominal, [hypothesis] * 3, starts, 0.0, prior):
        assert -2.0 < fitted.evidence + fitted.misfit - prior(hypothesis) <= 0.0


def test_two_simultaneous_faults_are_isolated_together() -> None:
    def truth(time: float) -> Tensor:
        return SPACE.vector({"T1.leak.size": 0.05, "h3.sensor_bias.bias": 0.01} if time > 100.0 else {})

    run_monitor = ObserverBank(NETWORK, SPACE, noise().gain, noise().whitening)
    best = isolate(run_monitor, from_rest(recorded(truth, 260)), SPACE.nominal(), FAULTS, deepest=2)[0]
    assert best.hypothesis.columns == (0, 4)
    for column, size in ((0, 0.05), (4, 0.01)):
        assert abs(float(best.value[column]) - size) < 4 * float(best.std[column])


def test_a_known_onset_is_kept_and_sharpens_the_size() -> None:
    run_monitor = ObserverBank(NETWORK, SPACE, noise().gain, noise().whitening)
    window = from_rest(recorded(step_to("T1.leak.size", 0.05, 100.0), 160))
    nominal, prior = SPACE.nominal(), Prior(SPACE.names, 1)
    start = torch.cat([nominal, nominal.new_tensor([100.0])])[None]
    [known], [free] = (
        fit(run_monitor, window, nominal, [Hypothesis((0,))], start, 0.0, prior, k) for k in (True, False)
    )
    assert known.onset == 100.0 and known.onset_std == 0.0 and free.onset != 100.0
    assert abs(float(known.value[0]) - 0.05) < 4 * float(known.std[0])
    assert float(known.std[0]) < float(free.std[0])


def test_standard_errors_are_those_of_repeated_runs() -> None:
    run_monitor = ObserverBank(NETWORK, SPACE, noise().gain, noise().whitening)
    pulls = []
    for seed in range(8):
        samples = recorded(step_to("T3.leak.size", 0.05, 60.0), 140, seed=seed)
        best = isolate(run_monitor, from_rest(samples), SPACE.nominal(), FAULTS[1:2], deepest=1)[0]
        pulls.append((float(best.value[1]) - 0.05) / float(best.std[1]))
    assert 0.5 < float(torch.tensor(pulls).square().mean().sqrt()) < 1.7  # 8 runs: 95 % within 0.5 to 1.5


def test_what_a_calibration_leaves_unknown_is_no_evidence_for_a_fault() -> None:
    """Constants with errors from the covariance of their calibration leave innovations that are white all the same."""
    names = ["P13.discharge_coefficient", "P32.discharge_coefficient", "OUT2.discharge_coefficient"]
    network = build_network(PLANT, [place("leak", "T1")])
    space = ParameterSpace([network.constants[n] for n in ("T1.leak.size", *names)])
    errors = ConstantErrors((1, 2, 3), torch.diag(torch.tensor([0.3, 0.1, 0.2], dtype=torch.float64).square()))
    learnt = learn_noise(
        network, recorded(lambda t: space.nominal(), 600, network, space, seed=99), space, space.nominal()
    )[0]
    misfits = {}
    for known in (ConstantErrors(), errors):
        observer = ObserverBank(network, space, learnt.gain, learnt.whitening, constants=known)
        total, readings = 0.0, 0
        for seed in range(10):
            drawn = torch.randn(3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
            theta = space.nominal()
            theta[1:] += drawn * errors.covariance.diagonal().sqrt() * prior_std(space)[1:]
            inputs = torch.tensor([50e-6, 50e-6], dtype=torch.float64).repeat(300, 1)
            inputs[100:200, 0] = 70e-6
            window = from_rest(recorded(lambda t, theta=theta: theta, 300, network, space, seed=seed, inputs=inputs))
            white = observer.white_innovations(window, space.nominal(), no_change(space.nominal()))
            total, readings = total + float(white.square().sum()), readings + window.readings
        misfits[known.columns] = total / readings
    assert misfits[()] > 1.5
    assert misfits[errors.columns] == pytest.approx(1.0, abs=4.0 * (2.0 / readings) ** 0.5)


def test_a_fault_free_run_has_no_events() -> None:
    _, events = followed(monitor(), recorded(lambda t: SPACE.nominal(), 500, seed=5))
    assert events == []


def test_gaps_jumps_bursts_and_unknown_inputs_are_reported() -> None:
    samples = recorded(lambda t: SPACE.nominal(), 300, seed=6)
    time, inputs = samples.time.clone(), samples.inputs.clone()
    time[100:] += 50.0
    time[200:] -= 500.0
    inputs[250:255] = torch.nan
    state, events = followed(monitor(), replace(samples, time=time, inputs=inputs))
    assert [event.kind for event in events] == ["notice"] * 3
    assert "no samples for 51 s" in events[0].text
    assert "the clock jumps back by 499 s" in events[1].text
    assert "an input is unknown" in events[2].text
    assert float(state.samples.time[-1]) == float(time[-1])


def test_known_faults_go_back_with_the_clock() -> None:
    """A growing fault is as large as before the jump, and a hidden one is examined as soon as without it."""
    samples, watch = recorded(lambda t: SPACE.nominal(), 200, seed=6), monitor()
    state, _ = followed(watch, samples.segment(0, 100))
    grown = FaultTrack(0, 1, 20.0, 1.0, (20.0, 0.0, 1e-3), (90.0, 0.07, 1e-3), 1.0, 90.0)
    state = replace(state, tracks=(grown,), hidden=(HiddenFault(grown, 0.07, 50.0, 95.0),))
    later = replace(samples.segment(100, 120), time=samples.time[100:120] - 5000.0)
    state, _ = watch.advance(state, later)
    [track], [hidden] = state.tracks, state.hidden
    assert track.at(state.now)[0] == pytest.approx(grown.at(state.now + 5000.0)[0], abs=2e-3)
    assert track.onset == pytest.approx(-4980.0, abs=1.0) and hidden.seen == pytest.approx(-4905.0, abs=1.0)
    assert watch.alarms.next_fit(state) < state.now + watch.settings.confirm


def test_an_observer_offset_is_reported_if_significant_and_relevant() -> None:
    """Noise of 1 mm in 3600 samples: an offset of 0.05 mm is significant but irrelevant, 0.5 mm is reported."""
    noise = torch.randn(3600, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    residual = 1e-3 * noise + torch.tensor([0.0, 5e-5, 5e-4], dtype=torch.float64)
    whitening = whitening_of(residual)
    assert bool((whitening.mean != 0.0).all())
    white = whitening(residual + whitening.mean)
    assert white.mean(0).tolist() == pytest.approx(whitening.offset.tolist())
    one = torch.ones(1, 3, dtype=torch.float64)
    seen = Observation(torch.arange(3600.0), residual, residual, one)
    noise_of_it = NoiseModel(one[0], 1.0, whitening, hand_gain(torch.eye(3, dtype=torch.float64)))
    detector = make_detector("fixed", 1e7, 1.0, 3, torch.Generator())
    [doubt] = residual_warnings(load_plant("three_tank"), noise_of_it, detector, seen)
    assert "h3 lies 0.04" in doubt and "cm off the observer throughout" in doubt


def test_a_repeated_sample_is_used_once() -> None:
    samples = recorded(lambda t: SPACE.nominal(), 6)
    twice = Samples(samples.time[[1, 1, 2]], samples.inputs[:3], samples.readings[[1, 1, 2]])
    [(kept, notice)], _ = split_at_gaps(ClockState(0.0), twice, 1.0)
    assert kept.time.tolist() == [1.0, 2.0] and notice == ""


def test_residuals_do_not_depend_on_how_samples_are_batched() -> None:
    samples = recorded(step_to("T3.leak.size", 0.05, 100.0), 180)
    _, few = followed(monitor(), samples, 10)
    _, single = followed(monitor(), samples, 5)
    assert [e.kind for e in few][:2] == [e.kind for e in single][:2]
    assert few[0].time == single[0].time and few[1].faults == single[1].faults
    _, whole = followed(monitor(), samples, len(samples))
    assert [e.kind for e in whole][:2] == [e.kind for e in few][:2]
    assert whole[0].time == few[0].time and whole[1].faults == few[1].faults


def test_an_event_is_one_line_and_plain_values() -> None:
    event = Event(12.0, "alarm", "the residual leaves its fault-free range")
    assert "\n" not in event.line and "12.0 s" in event.line
    assert json.loads(json.dumps(event.to_dict()))["faults"] == []


def test_misuse_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one fault to watch for"):
        Monitor(NETWORK, ParameterSpace(), noise(), monitor().detector)
    with pytest.raises(ValueError, match="lookback > 0"):
        replace(monitor().settings, lookback=0.0)
    late = build_network(PLANT, [place("pump_delay", "Q1")])
    with pytest.raises(ValueError, match="without pure delays, got Q1"):
        ObserverBank(late, SPACE, noise().gain, noise().whitening)


def test_no_range_goes_beyond_a_fully_open_valve() -> None:
    plant, time = load_plant("dts200"), torch.arange(9, dtype=torch.float64)
    name = "LM.valve_leak.size"
    assert end_reached(build_network(plant, [place("valve_leak", "LM")]).constants[name], 1.0) is None
    part = blank_recording(plant, torch.zeros(9, len(plant.channels()), dtype=torch.float64), time)
    with pytest.raises(ValueError, match=f"{name}: expected a range that ends at 1, a physical limit, got 0 to 2"):
        prepare_monitor(plant, part, [name], ranges={name: (0.0, 2.0)})


def test_a_fault_may_be_named_by_its_effect_alone(tmp_path: Path) -> None:
    file = tmp_path / "short.yaml"
    text = (
        "plant: three_tank\nrecording: {file: r.csv}\nfault_free: [0 s, 9 s]\nfaults: [T1.leak, h1.sensor_bias.bias]\n"
    )
    file.write_text(text + "ranges: {T1.leak: [0, 2]}\n")
    config = load_monitor(file).config
    assert config.faults == ["T1.leak.size", "h1.sensor_bias.bias"] and config.ranges == {"T1.leak.size": (0.0, 2.0)}


def test_usual_faults_are_one_of_each_component() -> None:
    assert len(usual_faults(PLANT)) == 3 + 3 + 2 * 2 + 3 * 3


LEAK = Path(__file__).parents[1] / "configs" / "monitor" / "three_tank_leak.yaml"


@pytest.mark.data
def test_the_real_leak_opens_at_61_s_and_nothing_else_is_found(
    monkeypatch: pytest.MonkeyPatch, real_data: Path
) -> None:
    monkeypatch.setenv("FDI_TORCH_DATA", str(real_data))
    wanted = load_monitor(LEAK)
    recording = read_recording(wanted.config.recording, wanted.plant, wanted.base)
    c = wanted.config
    ready = prepare_monitor(
        wanted.plant, fault_free_part(recording, *c.fault_free), c.faults, c.calibrate, c.detector,
        c.false_alarms_every, c.window.settings(), c.step, c.seed, c.recording.start_levels, c.ranges,
    )  # fmt: skip
    samples = samples_of_recording(recording, wanted.plant)
    state, events = ready.monitor.start(samples, ready.believed), []
    for first in range(1, len(samples), 10):
        state, news = ready.monitor.advance(state, samples.segment(first, first + 10))
        events += news
    assert [e.time for e in events if e.kind == "alarm"] == [64.0]
    assert all(e.faults == ("T2.leak.size",) for e in events if e.kind != "alarm")
    assert all(abs((e.onset or 0.0) - 61.0) < 2.0 for e in events if e.kind != "alarm")


@pytest.mark.data
def test_the_command_prints_one_line_of_json_an_event(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], real_data: Path, tmp_path: Path
) -> None:
    monkeypatch.setenv("FDI_TORCH_DATA", str(real_data))
    assert (
        main(
            [
                "monitor",
                "--config",
                str(LEAK),
                "--json",
                "--quiet",
                "--set",
                "recording.stop=90 s",
                "--out",
                str(tmp_path),
            ]
        )
        == 0
    )
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [e["kind"] for e in events] == ["watching", "notice", "alarm", "isolated", "summary"]
    assert all(e["format"] == "fdi_torch.event/3" for e in events)


def test_the_report_prints_the_inseparable_pair(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["diagnosability", "--plant", "three_tank", "--input", "50 cm^3/s,50 cm^3/s", "--duration", "200"]
    assert main([*words, "--faults", "T2.leak,OUT2.plugging.size,T1.leak.size"]) == 0
    shown = capsys.readouterr().out
    assert "both are flows in proportion to sqrt(2 g h) of T2" in shown
    # A tolerance of 3 % of an outlet's coefficient hides smaller leaks: some 3 % of its flow times both quantiles.
    least = next(line.split()[4] for line in shown.splitlines() if line.startswith("T2.leak.size"))
    assert 0.03 * (3.29 + 1.64) * 0.9 < float(least) < 0.2 and "uncertain within their tolerances: P13." in shown
    assert main(["diagnosability", "--plant", "three_tank", "--input", "50 cm^3/s"]) == 2


@pytest.mark.slow
def test_figures_6_and_7() -> None:
    """Faults at 1000 s and 2000 s, SNR 50: both alarms, none before, every parameter within 3 standard errors."""
    places = [("leak", "T1"), ("net_outlet", "OUT2"), ("leak", "T3"), ("openness", "P13"), ("openness", "P32")]
    network = build_network(PLANT, [place(*p) for p in places])
    space = ParameterSpace([network.constants[f"{at}.{effect}.size"] for effect, at in places])
    first = torch.tensor([0.1, 0.6, 0.0, 1.0, 1.0], dtype=torch.float64)
    second = torch.tensor([0.3, 0.3, 0.5, 0.6, 1.0], dtype=torch.float64)

    def truth(time: float) -> Tensor:
        return space.nominal() if time < 1000.0 else first if time < 2000.0 else second

    clean = recorded(truth, 3001, network, space, 0.0).readings
    std = clean.std(0) * 10**-2.5
    samples = recorded(truth, 3001, network, space, std, seed=2)
    free = Samples(
        samples.time[:1000],
        samples.inputs[:1000],
        REST + std * torch.randn(1000, 3, generator=torch.Generator().manual_seed(7), dtype=torch.float64),
    )
    learnt, _ = learn_noise(network, free, space, space.nominal())
    detector = make_detector("cusum", 20000.0, 1.0, 3, torch.Generator().manual_seed(0))
    run_monitor = Monitor(
        network, space, learnt, detector, MonitorSettings(200.0, 60.0, 1000.0, together=4, incipient=False)
    )
    _, events = followed(run_monitor, samples, 50)
    alarms = [event.time for event in events if event.kind == "alarm"]
    assert len(alarms) == 2 and 1000 < alarms[0] < 1010 and 2000 < alarms[1] < 2010
    ends = [[e for e in events if e.sizes and e.time <= end][-1] for end in (2000.0, 3000.0)]
    for event, expected in zip(ends, (first, second), strict=True):
        for name, size, std_error in zip(event.faults, event.sizes, event.stds, strict=True):
            assert abs(size - float(expected[space.index(name)])) < 3 * std_error, (name, size, std_error)


def test_the_initial_level_is_not_used_for_a_later_fault_free_part(tmp_path: Path) -> None:
    """A tank filled from empty by 50 cm^3/s, a flow read 10 % too low; the noise is learnt from 20 s on, at 10 cm."""
    noise = torch.randn(100, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).tolist()
    rows = [f"{t},{10 * (0.5 * t + 0.05 * e):.4f},45" for t, e in enumerate(noise)]
    (tmp_path / "run.csv").write_text("t_s,h_mm,Q_cm3_s\n" + "\n".join(rows) + "\n")
    (tmp_path / "watch.yaml").write_text(
        "plant:\n"
        "  tanks: {T: {area: 100 cm^2, height: 80 cm}}\n"
        "  pumps: {Q: {target: T, max_flow: 100 cm^3/s}}\n"
        "  sensors: {h: {tank: T}}\n"
        "  tolerances: {Q.gain: 20 %}\n"
        "recording: {file: run.csv, start_levels: {T: 0 cm}}\n"
        "fault_free: [20 s, 95 s]\ncalibrate: [Q.gain]\nfaults: [T.leak]\n"
        f"output: {{folder: {tmp_path}}}\n"
    )
    told: list[float] = []
    silent = MonitorCallbacks(lambda *_: None, lambda _: None, lambda ready: told.append(ready.calibrated["Q.gain"]))
    run_monitor(load_monitor(tmp_path / "watch.yaml"), silent)
    assert told == [pytest.approx(50.0 / 45.0, rel=0.01)]


def test_the_forecast_interval_contains_the_time_to_overflow() -> None:
    """A pipe that plugs: the tank upstream fills, and the interval becomes narrower until then."""
    samples = recorded(step_to("P13.plugging.size", 0.6, 200.0), 1100, std=0.0)
    height = PLANT.tanks[0].height
    truth = float((samples.readings[:, 0] >= height).nonzero()[0])
    noisy = samples.readings + STD * torch.randn(
        samples.readings.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64
    )
    _, events = followed(monitor(confirm=20.0), replace(samples, readings=noisy).segment(0, 330))
    told = [(e.time, limit) for e in events for limit in e.limits]
    assert len(told) >= 2 and all(limit.tank == "T1" and limit.what == "overflows" for _, limit in told)
    assert all(time + limit.low < truth < time + limit.high for time, limit in told)
    widths = [limit.high - limit.low for _, limit in told]
    assert widths == sorted(widths, reverse=True)


def test_a_tank_that_reached_its_rim_overflowed_whatever_the_random_flows_do_later() -> None:
    """The forecast interval is about as wide after the median as before it."""
    flows = noise().whitening.flows
    assert flows is not None
    disturbed = replace(flows, noise=replace(flows.noise, intensity=torch.full((3,), 4e-4, dtype=torch.float64)))
    watch = monitor(confirm=20.0)
    watch.observer.whitening = replace(noise().whitening, flows=disturbed)
    _, events = followed(watch, recorded(step_to("P13.plugging.size", 0.6, 200.0), 330))
    limits = [limit for e in events for limit in e.limits if limit.tank == "T1"]
    assert limits
    assert all(limit.high - limit.time < 3.0 * (limit.time - limit.low) for limit in limits)


def test_shocks_are_added_to_the_levels_of_a_simulation() -> None:
    bank, samples = monitor().observer, from_rest(recorded(lambda t: SPACE.nominal(), 31))
    quiet = replace(samples.samples, readings=torch.full_like(samples.samples.readings, torch.nan))
    shocks = torch.zeros(2, 30, 3, dtype=torch.float64)
    shocks[1, 9] = torch.tensor([0.02, -0.01, 0.03])
    both = ChangeHypotheses(
        SPACE.nominal().expand(2, -1), torch.full((2,), 1e30, dtype=torch.float64), shocks[:, 0, 0] > 1
    )
    start = REST.expand(2, -1) + 0.01
    plain, moved = bank.simulate(quiet, start, SPACE.nominal(), both, shocks)
    alone = bank.run(replace(samples, samples=quiet, state=start[0]), SPACE.nominal(), both)[0][0]
    assert torch.allclose(plain, alone, atol=1e-12)
    assert torch.allclose(moved[:9], plain[:9], atol=1e-12)
    assert torch.allclose(moved[9] - plain[9], shocks[1, 9], atol=1e-12)
    rest = quiet.segment(10, 31)
    later = bank.simulate(rest, moved[9][None], SPACE.nominal(), both.subset(0, 1), shocks[:1, 10:])
    assert torch.allclose(moved[10:], later[0], atol=1e-12)


def test_the_interval_of_a_forecast_holds_a_further_draw_in_90_percent() -> None:
    draws = torch.rand(4000, DRAWS + 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    limits = [limit_of("T1", "overflows", row[1:]) for row in draws]
    inside = [limit.low <= float(row[0]) <= limit.high for limit, row in zip(limits, draws, strict=True)]
    assert sum(inside) / len(inside) == pytest.approx(0.9, abs=0.015)
    never = torch.where(torch.arange(DRAWS) < DRAWS // 4, torch.inf, draws[0, 1:])
    assert limit_of("T1", "overflows", never).high == torch.inf


@pytest.mark.parametrize("onset", [203.0, 206.0, 209.0, 213.0])
def test_a_jump_of_a_reading_is_found_wherever_it_lies_between_the_tried_onsets(onset: float) -> None:
    """The observer follows a reading within a few samples, so that the jump shows in these only."""
    samples, believed = recorded(step_to("h3.sensor_bias.bias", 0.03, onset), 500, seed=5), SPACE.nominal()
    eye, zeros = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    whitening = Whitening(zeros, eye[:0].unsqueeze(1), eye / (1.3 * STD), 500, zeros)
    observer = ObserverBank(NETWORK, SPACE, hand_gain(0.8 * eye), whitening)
    fits = isolate(observer, from_rest(samples), believed, faults_of(SPACE.names))
    assert [SPACE.names[c] for c in fits[0].hypothesis.columns] == ["h3.sensor_bias.bias"]
    assert abs(fits[0].onset - (onset - 0.5)) < 1.0


def test_a_sensor_without_readings_is_named_with_its_remedy() -> None:
    mask = torch.ones(60, 3, dtype=torch.bool)
    mask[1:, 1] = False
    time, zeros = torch.arange(60.0, dtype=torch.float64), torch.zeros(60, 3, dtype=torch.float64)
    names = (("Q1", "Q2"), ("h1", "h2", "h3"), ("m^3/s",) * 2, ("m",) * 3)
    recording = Recording(time, zeros[:, :2], zeros, *names, mask=mask, source="rig")
    with pytest.raises(ValueError, match=r"rig \(0 to 50 s\): h2: .* got 1 in 51 samples, .* column or tag of h2"):
        fault_free_part(recording, 0.0, 50.0)
