"""Errors of sizes and laws of known faults in the residuals of the monitor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
from rigs import blank_recording
from torch import Tensor

from fdi_torch.effects import build_network, place
from fdi_torch.estimate.evidence import ODDS
from fdi_torch.monitor import law_errors
from fdi_torch.monitor.events import Event
from fdi_torch.monitor.flow_noise_estimate import by_initial_levels, estimate_flow_filter
from fdi_torch.monitor.law_errors import SIZE_ERROR, UNKNOWN, LawErrors
from fdi_torch.monitor.monitor import Monitor
from fdi_torch.monitor.monitor_setup import fault_free_part, prepare_monitor
from fdi_torch.monitor.noise_model import learn_noise
from fdi_torch.parameters import ParameterSpace
from fdi_torch.simulate.build import BuildError
from tests.test_monitor import (
    INPUTS,
    NETWORK,
    PLANT,
    SPACE,
    Truth,
    followed,
    monitor,
    noise,
    recorded,
    step_to,
)

DTYPE = torch.float64


def start(faults: int, correlation_time: float) -> LawErrors:
    nothing = torch.zeros(3, dtype=DTYPE)
    return LawErrors.at_start(range(faults), correlation_time, nothing, nothing, torch.zeros(0, 3, dtype=DTYPE))


def missing() -> None:
    raise BuildError("no compiler")


@pytest.mark.parametrize("compiler", [True, False])
@pytest.mark.parametrize("deviation", [0.0, UNKNOWN])
def test_innovations_beside_known_faults_are_those_of_the_normal_distribution_of_all_residuals(
    deviation: float, compiler: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its covariance is I + D (SIZE_ERROR^2 + law_error^2 exp(-|t - t'| / T)) D', for the readings that are there, and
    UNKNOWN^2 between those of one sensor beside a steady deviation."""
    if not compiler:
        monkeypatch.setattr(law_errors, "_library", missing)
    generator = torch.Generator().manual_seed(3)
    count, sensors, faults, time = 40, 3, 2, 25.0
    white, effects = (torch.randn(*n, count, sensors, generator=generator, dtype=DTYPE) for n in ((), (faults,)))
    effects = 5.0 * effects
    intervals = 0.5 + torch.rand(count, generator=generator, dtype=DTYPE)
    white[10, 1] = white[11, 1] = white[20] = torch.nan
    at = intervals.cumsum(0)
    shared = SIZE_ERROR**2 + ODDS.law_error**2 * torch.exp(-(at[:, None] - at).abs() / time)
    joint = torch.einsum("fsc,ftd,st->sctd", effects, effects, shared)
    joint = joint + deviation**2 * torch.eye(sensors, dtype=DTYPE)[:, None]
    joint = joint.reshape(count * sensors, -1)
    present = torch.isfinite(white).flatten()
    covariance = (joint + torch.eye(count * sensors, dtype=DTYPE))[present][:, present]
    expected = torch.linalg.solve_triangular(
        torch.linalg.cholesky(covariance), white.flatten()[present][:, None], upper=False
    ).flatten()
    errors = start(faults, time)
    errors = errors.with_unknown_deviation() if deviation else errors
    errors, first = errors.after(white[:15], effects[:, :15], intervals[:15])
    _, second = errors.after(white[15:], effects[:, 15:], intervals[15:])
    got = torch.cat([first, second]).flatten()
    assert torch.equal(torch.isfinite(got), present)
    assert torch.allclose(got[present], expected, rtol=1e-9, atol=1e-9)


def test_the_detector_gets_residuals_without_the_error_of_a_known_law() -> None:
    """A hole 25 cm above the floor, modelled as one in the floor, leaves more than noise in the residual."""
    space = ParameterSpace([NETWORK.constants["T1.leak.size"], NETWORK.constants["T1.leak.height"]])

    def truth(time: float) -> Tensor:
        return space.vector({"T1.leak.size": 0.3, "T1.leak.height": 0.25} if time >= 200.0 else {})

    state, _ = followed(monitor(), recorded(truth, 420, NETWORK, space), 50)
    own, left = (x[-60:].square().mean().sqrt() for x in (state.white, state.tested))
    assert 0.8 < float(left) < 1.3 < float(own)


def test_a_detector_beside_no_known_fault_gets_the_white_residuals() -> None:
    state, _ = followed(monitor(), recorded(lambda t: SPACE.nominal(), 100))
    assert torch.equal(state.white, state.tested)


@pytest.mark.parametrize(("bias", "seed"), [(0.0, 0), (5e-3, 0), (5e-3, 1)])
def test_the_end_of_a_fault_shows_as_soon_as_its_pump_runs_again_even_if_another_fault_came_meanwhile(
    bias: float, seed: int
) -> None:
    """Pump Q2 delivers 80 % until 400 s, and rests from 300 to 460 s."""
    inputs = INPUTS.repeat(520, 1)
    inputs[300:460, 1] = 0.0

    def truth(time: float) -> Tensor:
        gain = 0.8 if 100.0 <= time < 400.0 else 1.0
        return SPACE.vector({"Q2.pump_gain.factor": gain, "h3.sensor_bias.bias": bias if time >= 340.0 else 0.0})

    _, events = followed(monitor(), recorded(truth, 520, seed=seed, inputs=inputs))
    assert any(event.kind == "alarm" and 460.0 < event.time <= 470.0 for event in events)
    ended = next(event for event in events if event.kind == "recovered")
    assert ended.alarm == 1 and ended.time <= 510.0
    assert ended.onset is not None and ended.onset_std is not None
    assert abs(ended.onset - 400.0) <= 3.0**0.5 * ended.onset_std, "it ended while the pump rested"


@pytest.mark.parametrize("known", ["", "T1.leak.size"])
def test_a_fault_is_detected_as_soon_beside_a_known_one_as_alone(known: str) -> None:
    """5 mm are five standard deviations of the noise."""

    def truth(time: float) -> Tensor:
        leak = {known: 0.1} if known and time >= 100.0 else {}
        return SPACE.vector({**leak, "h3.sensor_bias.bias": 5e-3 if time >= 340.0 else 0.0})

    _, events = followed(monitor(), recorded(truth, 400))
    assert next(event.time for event in events if event.kind == "alarm" and event.time > 320.0) <= 344.0


def beside_steady_deviation(leaks: Truth, sensor: int, size: float, samples: int) -> list[Event]:
    """The events of a monitor for leaks of T1 alone if one sensor reads `size` m too much from 340 s on."""
    network = build_network(PLANT, [place("leak", "T1")])
    space = ParameterSpace([network.constants["T1.leak.size"]])
    whole = recorded(leaks, samples)
    readings = whole.readings.clone()
    readings[340:, sensor] += size
    usual = monitor()
    watch = Monitor(network, space, noise(), usual.detector, usual.settings)
    return followed(watch, replace(whole, readings=readings))[1]


@pytest.mark.parametrize("size", [4e-3, 2e-2])
@pytest.mark.parametrize("sensor", [1, 2])
@pytest.mark.parametrize("known", [0.0, 0.1])
def test_a_steady_deviation_that_no_fault_explains_does_not_raise_one_alarm_after_another(
    known: float, sensor: int, size: float
) -> None:
    """Each answer restarts the detector: at the deviation alone it alarmed again within 30 s, 14 to 21 times in all."""
    events = beside_steady_deviation(step_to("T1.leak.size", known, 100.0), sensor, size, 1200)
    alarms = [event.time for event in events if event.kind == "alarm" and event.time >= 340.0]
    assert alarms[0] <= 350.0
    assert len(alarms) <= 3  # the observer settles on a large deviation over minutes
    assert not any("chance" in event.text for event in events if event.kind == "cannot tell")


def test_a_fault_is_detected_as_soon_beside_a_steady_deviation_as_alone() -> None:
    first = []
    for size in (0.0, 4e-3):
        events = beside_steady_deviation(step_to("T1.leak.size", 0.1, 700.0), 2, size, 760)
        first.append(next(event.time for event in events if event.kind == "alarm" and event.time > 600.0))
    assert 700.0 < first[1] <= first[0] + 2.0


CONSTANTS = [f"{pipe.name}.discharge_coefficient" for pipe in PLANT.pipes]
OF_CONSTANTS = ParameterSpace([NETWORK.constants[name] for name in [*CONSTANTS, "T1.leak.size"]])


def learnt_at_rest(
    seed: int, learn: int, leak: float, calibrate: Sequence[str] = CONSTANTS
) -> tuple[list[Event], float]:
    """The events of a rig with drawn constants after `learn` s at rest, on which constants are calibrated, and 800 s of
    moving pumps, with a leak from 600 s on. And the squared errors of the constants by their covariance.
    """
    generator = torch.Generator().manual_seed(seed)
    nominal, std = OF_CONSTANTS.nominal(), OF_CONSTANTS.std()
    drawn = std[:-1] * torch.randn(len(CONSTANTS), generator=generator, dtype=DTYPE)
    sound = nominal + torch.cat([drawn, drawn.new_zeros(1)])
    leaking = sound + torch.tensor([*(0.0 for _ in CONSTANTS), leak], dtype=DTYPE)
    steps = 3e-5 + 4e-5 * torch.rand(4, 2, generator=generator, dtype=DTYPE)
    inputs = torch.cat([INPUTS.repeat(learn, 1), steps.repeat_interleave(200, 0)])

    def truth(time: float) -> Tensor:
        return leaking if time >= 600.0 else sound

    samples = recorded(truth, len(inputs), NETWORK, OF_CONSTANTS, seed=seed, inputs=inputs)
    whole = replace(blank_recording(PLANT, inputs, samples.time), outputs=samples.readings, mask=None)
    prepared = prepare_monitor(PLANT, fault_free_part(whole, 0.0, learn), ["T1.leak.size"], calibrate)
    state = prepared.monitor.start(samples, prepared.believed, learning_until=learn)
    _, events = prepared.monitor.advance(state, samples.segment(1, len(samples)))
    columns = [prepared.monitor.space.index(name) for name in CONSTANTS]
    error = (prepared.believed[columns] - sound[:-1]) / std[:-1]
    covariance = prepared.monitor.noise.constants.covariance
    return events, float(error @ torch.linalg.solve(covariance, error))


@pytest.mark.parametrize("calibrate", [CONSTANTS, []])
@pytest.mark.parametrize(("seed", "learn"), [(20261555, 300), (20261566, 100)])
def test_errors_of_constants_raise_no_alarm(seed: int, learn: int, calibrate: Sequence[str]) -> None:
    """Of a sound rig, whether its constants are calibrated on a part at rest or have the plant file's values; constants
    that count as exact raise an alarm."""
    events, square = learnt_at_rest(seed, learn, 0.0, calibrate)
    assert not [event for event in events if event.kind == "alarm"]
    assert square <= 16.3  # 99.9 % of chi-square with three degrees of freedom


@pytest.mark.parametrize("calibrate", [CONSTANTS, []])
def test_errors_of_constants_hide_no_fault_beyond_their_tolerance(calibrate: Sequence[str]) -> None:
    """A leak of 0.1 draws as much as an outlet whose coefficient is 10 % larger; the tolerance is 3 %."""
    events, _ = learnt_at_rest(20261566, 100, 0.1, calibrate)
    assert 600.0 < next(event.time for event in events if event.kind == "alarm") <= 620.0


def test_effects_of_constants_are_linear_about_their_most_likely_values() -> None:
    """Coefficients that are 2.5 tolerances off, in a recording that determines them to a tenth of a tolerance."""
    generator = torch.Generator().manual_seed(20261573)
    off = OF_CONSTANTS.std()[:-1] * torch.tensor([2.5, -2.5, 2.5], dtype=DTYPE)
    sound = OF_CONSTANTS.nominal() + torch.cat([off, off.new_zeros(1)])
    inputs = (3e-5 + 4e-5 * torch.rand(8, 2, generator=generator, dtype=DTYPE)).repeat_interleave(200, 0)
    samples = recorded(lambda time: sound, len(inputs), NETWORK, OF_CONSTANTS, seed=20261573, inputs=inputs)
    whole = replace(blank_recording(PLANT, inputs, samples.time), outputs=samples.readings, mask=None)
    prepared = prepare_monitor(PLANT, fault_free_part(whole, 0.0, 1000.0), ["T1.leak.size"])
    columns = [prepared.monitor.space.index(name) for name in CONSTANTS]
    assert bool(((prepared.believed[columns] - sound[:-1]).abs() < 0.2 * OF_CONSTANTS.std()[:-1]).all())


def test_flows_are_learnt_from_the_likelihood_that_is_averaged_over_levels_and_errors_of_constants() -> None:
    """The log density of the dense normal distribution of all readings. The likelihood with the most likely errors
    takes a part of slow flows for errors of constants.
    """
    flows = learn_noise(NETWORK, recorded(lambda t: SPACE.nominal(), 60))[0].whitening.flows
    assert flows is not None
    free, (samples, sensors) = flows.learnt, flows.learnt.shape
    effects = torch.randn(2, samples, sensors, generator=torch.Generator().manual_seed(20261579), dtype=DTYPE)
    effects = 3e-3 * effects.cumsum(1)
    nothing = replace(flows.observer, steady=0.0 * flows.observer.steady, opening=0.0 * flows.observer.opening)
    given = flows.linear, nothing, free / nothing.spread(0, samples), effects / nothing.spread(0, samples)
    learnt, log_likelihood = estimate_flow_filter(*given, effects.new_zeros(2), flows.reading_std, flows.start_std, 1.0)
    torch.testing.assert_close(learnt.learnt, free)
    rows = torch.eye(samples * sensors, dtype=DTYPE).reshape(-1, samples, sensors)
    by_levels = by_initial_levels(flows.linear, samples) * flows.start_std
    columns = torch.cat([by_levels, effects.permute(1, 2, 0)], -1).flatten(0, 1)
    covariance, y = learnt.covariance_of_sums(rows) + columns @ columns.mT, free.flatten()
    expected = -0.5 * float(y @ torch.linalg.solve(covariance, y)) - 0.5 * float(torch.logdet(covariance))
    assert log_likelihood == pytest.approx(expected + learnt.noise.log_prior(), abs=1e-3)


def test_the_covariance_of_least_squares_is_that_of_estimates_from_drawn_flows_and_noise() -> None:
    """Weighted sums of 4000 simulated free runs."""
    flows = learn_noise(NETWORK, recorded(lambda t: SPACE.nominal(), 120))[0].whitening.flows
    assert flows is not None
    flows = replace(flows, noise=replace(flows.noise, intensity=torch.full((3,), 3e-4), correlation_time=20.0))
    generator = torch.Generator().manual_seed(20261565)
    runs, samples = 4000, 60
    rows = torch.randn(2, samples, 3, generator=generator, dtype=DTYPE)
    state = flows.flow_std * torch.randn(runs, 3, generator=generator, dtype=DTYPE)
    state, sums = torch.cat([torch.zeros_like(state), state], 1), torch.zeros(runs, 2, dtype=DTYPE)
    for k in range(samples):
        noise = flows.white_std * torch.randn(runs, 3, generator=generator, dtype=DTYPE)
        sums += (state @ flows.joint.output.mT + noise) @ rows[:, k].mT
        shocks = flows.process_std * torch.randn(runs, 6, generator=generator, dtype=DTYPE)
        state = state @ flows.transition.mT + shocks
    expected, got = flows.covariance_of_sums(rows), torch.cov(sums.mT)
    scale = expected.diagonal().sqrt()
    assert float(((got - expected) / scale / scale[:, None]).abs().max()) < 0.1  # four standard errors
