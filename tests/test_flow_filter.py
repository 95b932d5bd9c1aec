"""Random flows into the tanks: the monitor's white residual stays white, whatever their correlation time."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from scipy.signal import lfilter
from scipy.stats import poisson
from torch import Tensor

from benchmarks.monitor_rigs import Case, recordings
from fdi_torch.config.plant_file import load_plant
from fdi_torch.effects import build_network, placements_for
from fdi_torch.estimate.evidence import posterior
from fdi_torch.estimate.noise_model import StateNoise
from fdi_torch.monitor import noise_model
from fdi_torch.monitor.detection import make_detector
from fdi_torch.monitor.fault_free_checks import QUESTION, false_alarm_rate_text
from fdi_torch.monitor.flow_filter import FlowFilter, forcing
from fdi_torch.monitor.flow_noise_estimate import estimate_flow_filter
from fdi_torch.monitor.hypothesis import NO_CHANGE, Hypothesis, HypothesisFit
from fdi_torch.monitor.hypothesis_fit import Prior, fit, misfit, no_change_fit
from fdi_torch.monitor.isolation import with_flows_of_window
from fdi_torch.monitor.level_forecast import POINTS, _grid, _random_flows
from fdi_torch.monitor.monitor_setup import fault_free_part, prepare_monitor
from fdi_torch.monitor.noise_model import learn_noise, operating_point
from fdi_torch.monitor.observer import Observer
from fdi_torch.monitor.observer_bank import ObserverBank, ObserverWindow, no_change
from fdi_torch.monitor.observer_gain import Linear, hand_gain, start_uncertainty
from fdi_torch.monitor.samples import Samples
from fdi_torch.parameters import ParameterSpace
from fdi_torch.simulate.build import BuildError
from fdi_torch.simulate.equilibrium import equilibrium

PLANT = load_plant("three_tank")
NETWORK = build_network(PLANT, [])
INPUTS = torch.tensor([50e-6, 50e-6], dtype=torch.float64)
LEARN, BLOCK, STD, FLOW = 2000, 100, 1e-3, 1.5e-6
AREA = np.array([tank.area for tank in PLANT.tanks])


CORRELATION_TIMES = (1.0, 15.0, 80.0, 150.0)  # s


def rates(levels: np.ndarray) -> np.ndarray:
    """dh/dt (lanes, 3) of the three tanks by Torricelli's law, m/s."""
    heads = np.stack([levels[:, 0] - levels[:, 2], levels[:, 2] - levels[:, 1], levels[:, 1]])
    strength = [p.discharge_coefficient * p.area * math.sqrt(2.0 * PLANT.gravity) for p in PLANT.pipes]
    first, second, outlet = np.sign(heads) * np.sqrt(np.abs(heads)) * np.array(strength)[:, None]
    pumped = INPUTS.numpy()
    return np.stack([pumped[0] - first, pumped[1] + second - outlet, first - second], axis=1) / AREA


@cache
def disturbed_levels() -> Tensor:
    """Levels (5, samples, 3) of the three tanks about their equilibrium by the midpoint rule, with random flows into
    each of each correlation time, and at last without.
    """
    generator, samples, lanes = torch.Generator().manual_seed(0), 3 * LEARN, len(CORRELATION_TIMES) + 1
    draws = torch.randn(samples, lanes, 3, generator=generator, dtype=torch.float64).numpy()
    times = np.array([[*CORRELATION_TIMES, 1.0]]).T
    flow, keep = np.full_like(times, FLOW), np.exp(-1.0 / times)
    flow[-1] = 0.0
    level, now = np.tile(equilibrium(NETWORK, INPUTS).numpy(), (lanes, 1)), flow * draws[0]
    levels = np.empty((samples, lanes, 3))
    for k in range(samples):
        levels[k] = level
        level = level + rates(level + 0.5 * rates(level)) + now / AREA
        now = keep * now + np.sqrt(1.0 - keep**2) * flow * draws[k]
    return torch.from_numpy(levels).movedim(0, 1)


def disturbed(correlation_time: float | None, samples: int) -> Samples:
    """Readings under random flows of that correlation time, or under none."""
    lane = -1 if correlation_time is None else CORRELATION_TIMES.index(correlation_time)
    noise = STD * torch.randn(samples, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    readings = disturbed_levels()[lane, :samples] + noise
    return Samples(torch.arange(samples, dtype=torch.float64), INPUTS.expand(samples, 2), readings)


def spread_of_sums(white: Tensor) -> Tensor:
    """Standard deviation of the sums over blocks, over that of white noise of unit variance, (sensors,)."""
    blocks = white[: len(white) // BLOCK * BLOCK].reshape(-1, BLOCK, white.shape[-1])
    return blocks.sum(1).square().mean(0).sqrt() / math.sqrt(BLOCK)


@pytest.mark.parametrize("correlation_time", [1.0, 15.0, 150.0])
def test_sums_of_the_white_residual_spread_like_those_of_white_noise(correlation_time: float) -> None:
    """On 4000 samples after learning: 40 blocks, whose spread is known to 11 %; the noise is learnt to 6 %."""
    samples = disturbed(correlation_time, 3 * LEARN)
    noise, _ = learn_noise(NETWORK, samples.segment(0, LEARN))
    white = noise.whitening(Observer(NETWORK, noise.gain).run(samples).steady_residual)[LEARN:]
    assert white.std(dim=0).tolist() == pytest.approx([1.0] * 3, abs=0.1)
    assert spread_of_sums(white).tolist() == pytest.approx([1.0] * 3, abs=4.0 * math.hypot(0.11, 0.06))


@pytest.mark.parametrize("correlation_time", [None, 1.0, 150.0])
def test_correlated_noise_of_sensors_is_not_taken_for_random_flows(correlation_time: float | None) -> None:
    """AR(1) noise of 0.7, alone or beside flows. As flows, it would leave sums whose spread is a third of that of white
    noise; as part of an autoregression beside slow flows, sums with twice the spread.
    """
    whole, keep = disturbed(correlation_time, 3 * LEARN), 0.7
    lane = -1 if correlation_time is None else CORRELATION_TIMES.index(correlation_time)
    levels = disturbed_levels()[lane, : 3 * LEARN]
    shocks = math.sqrt(1.0 - keep**2) * (whole.readings - levels)
    noise = torch.from_numpy(lfilter([1.0], [1.0, -keep], shocks.numpy(), axis=0))
    samples = replace(whole, readings=levels + noise)
    learnt, _ = learn_noise(NETWORK, samples.segment(0, LEARN))
    white, flows = (
        learnt.whitening(Observer(NETWORK, learnt.gain).run(samples).steady_residual)[LEARN:],
        learnt.whitening.flows,
    )
    assert flows is not None and flows.correlation == keep
    assert flows.reading_std.tolist() == pytest.approx([STD] * 3, rel=0.1)
    assert white.std(dim=0).tolist() == pytest.approx([1.0] * 3, abs=0.1)
    assert spread_of_sums(white).tolist() == pytest.approx([1.0] * 3, abs=4.0 * math.hypot(0.11, 0.06))


@pytest.mark.parametrize("correlation_time", [15.0, 150.0])
def test_flows_learnt_from_a_window_too_are_those_of_the_whole_recording(correlation_time: float) -> None:
    """From 300 samples alone, the correlation time is wrong by a factor of two or three."""
    samples = disturbed(correlation_time, 2 * LEARN)
    noise, _ = learn_noise(NETWORK, samples.segment(0, 300))
    residual, flows = Observer(NETWORK, noise.gain).run(samples).steady_residual, noise.whitening.flows
    assert flows is not None
    exact = residual.new_zeros(0, *residual.shape)
    further = noise.whitening.learning_from(residual[300:], exact[:, 300:], 300)[0]
    known = flows.reading_std, flows.start_std, 1.0
    whole, _ = estimate_flow_filter(flows.linear, noise.gain, residual, exact, residual.new_zeros(0), *known)
    assert further.flows is not None
    found, expected = further.flows.noise, whole.noise
    assert found.correlation_time == pytest.approx(expected.correlation_time, rel=0.05)
    assert flows.noise.correlation_time != pytest.approx(expected.correlation_time, rel=0.3)
    assert found.intensity.tolist() == pytest.approx(expected.intensity.tolist(), rel=0.05)
    white = further.of_innovations(further.innovations(residual[300:], 300)[0])
    assert white.std(dim=0).tolist() == pytest.approx([1.0] * 3, abs=0.1)
    assert spread_of_sums(white).tolist() == pytest.approx([1.0] * 3, abs=4.0 * 0.11)


def ranked_beside_small_flows(
    names: Sequence[str], run: Samples, share: float, hypotheses: Sequence[Hypothesis], starts: Tensor
) -> tuple[ObserverBank, ObserverWindow, list[HypothesisFit], Prior]:
    """The hypotheses from the 300th sample on, likeliest first, beside flows with a share of the intensity that was
    learnt from the first 300 samples. starts (H, P+1): values and onsets.
    """
    network = build_network(PLANT, placements_for(names))
    space = ParameterSpace([network.constants[name] for name in names])
    nominal = space.nominal()
    learnt, _ = learn_noise(network, run.segment(0, 300), space, nominal)
    flows = learnt.whitening.flows
    assert flows is not None
    small = replace(flows, noise=replace(flows.noise, intensity=share * flows.noise.intensity))
    whitener = learnt.whitening.whitener * (flows.innovation_std / small.innovation_std)
    bank = ObserverBank(network, space, learnt.gain, replace(learnt.whitening, flows=small, whitener=whitener))
    seen = Observer(network, learnt.gain, space, nominal).run(run)
    window = ObserverWindow(run.segment(299, len(run)), seen.state[299], 300, small(seen.steady_residual)[1][299])
    base = bank.white_innovations(window, nominal, no_change(nominal))
    prior = Prior(space.names, 4, (300.0, 8000.0))
    fits = fit(bank, window, nominal, hypotheses, starts, misfit(base), prior)
    ranked = sorted([*fits, no_change_fit(bank, window, nominal, base)], key=lambda f: -f.evidence)
    shares = posterior([f.evidence for f in ranked])
    return bank, window, [replace(f, probability=p) for f, p in zip(ranked, shares, strict=True)], prior


def test_a_fault_is_fitted_again_however_much_flows_learnt_as_too_small_favour_a_second_one() -> None:
    """A bias of h1 from 700 s on, and flows learnt with a twentieth of their intensity: plugging beside it explains
    what the flows do. With the flows of the window it does not.
    """
    names, run = ("P32.plugging.size", "h1.sensor_bias.bias"), disturbed(150.0, 1500)
    run.readings[700:, 0] += 0.03
    starts, hypotheses = torch.tensor([[0.0, 0.03, 700.0]], dtype=torch.float64), [Hypothesis((1,)), Hypothesis((0, 1))]
    bank, window, ranked, prior = ranked_beside_small_flows(names, run, 0.05, hypotheses, starts.repeat(2, 1))
    assert ranked[0].hypothesis.columns == (0, 1) and ranked[0].evidence - ranked[1].evidence > 20.0
    again = with_flows_of_window(bank, window, bank.space.nominal(), ranked, prior)[1]
    assert again[0].hypothesis.columns == (1,) and again[0].probability > 0.99


def test_chance_is_compared_with_the_flows_that_are_most_likely_without_a_fault() -> None:
    """No fault, and flows learnt with half their intensity: in 160 s, a leak of T3 explains what the flows do. Beside
    the flows that are most likely with this leak, chance has odds of 1 to 5000; beside its own, of 1 to 1.
    """
    run, start = disturbed(80.0, 460), torch.tensor([[0.02, 310.0]], dtype=torch.float64)
    hypotheses = [Hypothesis((0,)), Hypothesis((0,), incipient=True)]
    bank, window, ranked, prior = ranked_beside_small_flows(("T3.leak.size",), run, 0.5, hypotheses, start.repeat(2, 1))
    assert ranked[0].hypothesis.columns and ranked[0].evidence > 20.0
    again = with_flows_of_window(bank, window, bank.space.nominal(), ranked, prior)[1]
    assert next(f for f in again if f.hypothesis == NO_CHANGE).probability > 0.2


@pytest.mark.parametrize(
    ("fault", "onset", "kind", "seed"),
    [
        ("", math.inf, "held", 50100600),
        ("Q1.pump_gain.factor", 120.0, "white", 51200000),
        ("Q1.pump_gain.factor", 0.0, "slow", 51600800),
        ("P32.plugging.size", 120.0, "held", 888019),
        ("h3.sensor_gain.factor", 0.0, "slow", 888025),
    ],
)
def test_a_fault_in_the_fault_free_part_is_told_from_small_random_flows(
    fault: str, onset: float, kind: str, seed: int
) -> None:
    """300 s under control. If only a fault could move the levels, the flows would be a leak of T3 of 0.009 ± 0.0007. A
    pump that delivers 12 % less, from 120 s on, leaves more than the noise of the sensors beside the flows. From the
    start on, it looks like a slow flow, as does a gain of h3. The flows that were learnt without a fault hide plugging.
    """
    [(recording, _)] = recordings([Case(fault, 0.0, kind, 300.0, onset, 320.0, True, seed, flows=0.3)], step=0.25)
    prepared = prepare_monitor(PLANT, fault_free_part(recording, 0.0, 300.0))
    asked = [text for text in prepared.warnings if QUESTION in text]
    place = fault.partition(".")[0]
    told = [t for t in asked if re.match(rf".* at {place} .* since {onset:.0f} s, .* explains the part taken", t)]
    assert len(told) == bool(asked) == bool(fault)


def test_innovations_are_white_at_every_frequency() -> None:
    """T T^H is the identity for the amplitudes T by all sources."""
    flows = learn_noise(NETWORK, disturbed(15.0, 400))[0].whitening.flows
    assert flows is not None
    spectrum = flows.spectra @ flows.spectra.mH
    torch.testing.assert_close(spectrum, torch.eye(3, dtype=spectrum.dtype).expand_as(spectrum), atol=1e-6, rtol=0.0)


def test_longer_sums_are_less_certain_where_flows_are_slow() -> None:
    """Without flows their intensity cannot be known and matters little."""
    still, slow = (learn_noise(NETWORK, disturbed(time, 1000))[0].whitening.flows for time in (None, 150.0))
    assert still is not None and slow is not None
    assert float(still.error_of_sums(20).max()) < 0.1 < float(slow.error_of_sums(100).min())
    errors = torch.stack([slow.error_of_sums(n) for n in (1, 5, 20, 100)])
    assert errors[0].abs().max() < 1e-9 and bool((errors.diff(dim=0) > 0.0).all())


@pytest.mark.slow
def test_the_stated_error_of_sums_is_that_of_many_calibrations() -> None:
    """12 calibrations of 500 samples, each tested on the other 5500."""
    samples, deviations = disturbed(15.0, 3 * LEARN), []
    for first in range(0, 3 * LEARN, 500):
        noise, _ = learn_noise(NETWORK, samples.segment(first, first + 500))
        white = noise.whitening(Observer(NETWORK, noise.gain).run(samples).steady_residual)[100:]
        blocks = white.reshape(-1, 20, 3).sum(1)
        error = torch.hypot(*noise.whitening.errors_of_sums(20))
        deviations.append(0.5 * torch.log(blocks.square().mean(0) / 20.0) / error)
    # 36 values, three of which are of one calibration.
    assert 0.7 < float(torch.stack(deviations).square().mean().sqrt()) < 1.4


def test_the_start_tells_how_many_false_alarms_are_possible_if_one_is_expected() -> None:
    """If the noise is known, 0 to 3 by the Poisson distribution; if 600 samples determine it, more."""
    noise, _ = learn_noise(NETWORK, disturbed(15.0, 600))
    known = replace(noise.whitening, samples=10**9, slow_error=torch.zeros(3, dtype=torch.float64), flows=None)
    most, thresholds = [], []
    for whitening in (known, noise.whitening):
        detector = make_detector("cusum", 20_000.0, 1.0, 3, torch.Generator().manual_seed(0), learnt=whitening)
        text = false_alarm_rate_text(replace(noise, whitening=whitening), detector, 20_000.0)
        found = re.search(r"expect one false alarm in 20000 s \(0 to (\d+) with a probability of 95 %\)", text)
        assert found is not None
        most.append(int(found[1]))
        thresholds.append(detector.threshold)
        assert ("the fault-free part is short" in text) is (whitening is not known)
    assert most[0] == poisson.ppf(0.975, 1.0)
    assert most[1] > most[0]
    assert f"the threshold is {100.0 * (thresholds[1] / thresholds[0] - 1.0):.2g} % higher" in text


def test_without_a_compiler_the_start_tells_what_is_not_modelled(monkeypatch: pytest.MonkeyPatch) -> None:
    samples = disturbed(15.0, 600)

    def told() -> str:
        noise, _ = learn_noise(NETWORK, samples)
        generator = torch.Generator().manual_seed(0)
        detector = make_detector("fixed", 20_000.0, 1.0, 3, generator, learnt=noise.whitening)
        return false_alarm_rate_text(noise, detector, 20_000.0)

    def missing(*arguments: object) -> None:
        raise BuildError("no compiler")

    assert "compiler" not in told()
    monkeypatch.setattr(noise_model, "estimate_flow_filter", missing)
    assert "if no random flow is slow: to model these, install a C++ compiler" in told()


def test_innovations_do_not_depend_on_the_gain_of_the_observer() -> None:
    samples, whites = disturbed(15.0, 1000), []
    linear = operating_point(NETWORK, samples)
    heights = start_uncertainty(NETWORK.description, samples.readings)
    for share in (0.2, 0.6):
        gain = hand_gain(share * torch.eye(3, dtype=torch.float64))
        residual = Observer(NETWORK, gain).run(samples).steady_residual
        exact = residual.new_zeros(0, *residual.shape)
        known = exact, residual.new_zeros(0), residual.std(dim=0), heights, 1.0
        flows, _ = estimate_flow_filter(linear, gain, residual, *known)
        whites.append(flows(residual)[0][100:])
    assert float((whites[0] - whites[1]).square().mean().sqrt()) < 0.02 * float(whites[0].square().mean().sqrt())


@pytest.mark.parametrize("correlation", [0.0, 0.7])
def test_filtering_in_parts_gives_the_same_innovations_to_the_last_bit(correlation: float) -> None:
    noise, seen = learn_noise(NETWORK, disturbed(15.0, 600))
    assert noise.whitening.flows is not None
    residual, flows = seen.steady_residual, replace(noise.whitening.flows, correlation=correlation)
    residual[50, 1] = torch.nan
    whole, path = flows(residual)
    first, memory = flows(residual[:70])
    second, _ = flows(residual[70:], 70, memory[-1])
    assert torch.equal(torch.cat([first, second]).nan_to_num(), whole.nan_to_num())
    assert bool(whole[50].isnan().equal(torch.tensor([False, True, False]))) and bool(path.isfinite().all())
    lanes = flows(residual.expand(3, -1, -1), 0, torch.zeros(3, path.shape[-1], dtype=path.dtype))[0]
    assert torch.equal(lanes[2].nan_to_num(), whole.nan_to_num())


def test_a_flow_that_is_held_over_a_sample_decays_within_it() -> None:
    """The integral of exp(-k s) over a sample is (1 - exp(-k)) / k; the trapezoidal rule is off by k^2 / 12."""
    rates = torch.tensor([0.001, 0.02, 0.1], dtype=torch.float64)
    held = torch.diagonal(forcing(torch.diag(torch.exp(-rates))))
    assert held.tolist() == pytest.approx(((1.0 - torch.exp(-rates)) / rates).tolist(), rel=1e-3)


def test_shocks_that_add_up_over_samples_have_the_covariance_of_the_recursion() -> None:
    flows = learn_noise(NETWORK, disturbed(15.0, 400))[0].whitening.flows
    assert flows is not None
    transition, total = torch.eye(6, dtype=torch.float64), torch.zeros(6, 6, dtype=torch.float64)
    correlated = replace(flows, correlation=0.7)
    assert all(torch.equal(a, b) for a, b in zip(flows.over(5), correlated.over(5), strict=True))
    for count in range(1, 8):
        transition = flows.transition @ transition
        total = flows.transition @ total @ flows.transition.mT + torch.diag(flows.process_std**2)
        for own, expected in zip(flows.over(count), (transition, total), strict=True):
            torch.testing.assert_close(own, expected)


@pytest.mark.parametrize("correlation_time", [15.0, 80.0, 150.0])
def test_the_estimate_has_the_flow_that_was_simulated(correlation_time: float) -> None:
    samples = disturbed(correlation_time, 4000)
    noise, _ = learn_noise(NETWORK, samples)
    flows = noise.whitening.flows
    assert flows is not None
    expected, variances = FLOW / PLANT.tanks[0].area, torch.diagonal(flows.covariance_of_parameters)
    assert flows.keep == pytest.approx(math.exp(-1.0 / correlation_time), abs=2.0 * float(variances[-1]) ** 0.5)
    error = 0.5 * float(variances[:3].max()) ** 0.5
    assert flows.noise.intensity.tolist() == pytest.approx([expected] * 3, rel=4.0 * error)
    assert flows.reading_std.tolist() == pytest.approx([STD] * 3, rel=0.05)
    assert float(flows.error_of_sums(100).max()) < 0.15
    assert operating_point(NETWORK, samples).transition.shape == (3, 3)


@pytest.mark.parametrize(("interval", "horizon"), [(1.0, 800.0), (1.0, 4000.0), (7.0, 4000.0), (20.0, 1500.0)])
def test_a_forecast_has_the_random_flows_that_were_learnt_at_any_sampling_interval(
    interval: float, horizon: float
) -> None:
    """A tank without outflow integrates white flows of 1 mm/s over one second: a random walk."""
    one, none = torch.eye(1, dtype=torch.float64), torch.zeros(0, 1, dtype=torch.float64)
    white = StateNoise(1e-3 * interval * one[0], 0.0, one[0])
    known = Linear(one, one), white, 1e-9 * one[0], hand_gain(one), one[0], interval
    flows = FlowFilter(*known, none, none.unsqueeze(-1)[..., :0], none[0:0, 0])
    points, span = _grid(horizon, interval)
    assert points <= POINTS and points * span == pytest.approx(horizon, abs=0.5 * span)
    memory, generator = torch.zeros(4000, 5, dtype=torch.float64), torch.Generator().manual_seed(1)
    _, shocks = _random_flows(flows, memory, points, span, generator)
    assert float(shocks.sum(1).std()) == pytest.approx(1e-3 * (points * span * interval) ** 0.5, rel=0.05)
