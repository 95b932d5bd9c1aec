"""Thresholds against published run lengths, and false alarms on noise with several autocorrelations."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from rigs import whitening_of
from scipy import stats

from fdi_torch.monitor.detection import (
    CHARTS,
    Chart,
    ChartRate,
    Detector,
    FalseAlarmDesign,
    cusum,
    cusum_rate,
    fixed_rate,
    latin_hypercube,
    make_detector,
)
from fdi_torch.monitor.whitening import score_whitenings


def noise(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def known(rate: ChartRate, run_length: float, channels: int) -> FalseAlarmDesign:
    """The design for noise that is known."""
    zeros, median = torch.zeros(channels, dtype=torch.float64), torch.full((2, 1, channels), 0.5, dtype=torch.float64)
    return FalseAlarmDesign(rate, lambda threshold: 1, lambda length: (zeros, zeros), median, run_length, 1.0)


def cusum_run_length(threshold: float, drift: float, std: float = 1.0) -> float:
    """Mean number of samples until one of the two sums of one channel exceeds the threshold."""
    return 1.0 / float(cusum_rate(threshold, torch.full((1, 1), std, dtype=torch.float64), drift))


def detector_of(chart: Chart, time_between_false_alarms: float) -> Detector:
    return make_detector(chart, time_between_false_alarms, 1.0, 3, torch.Generator())


@pytest.mark.parametrize(("threshold", "run_length"), [(4.0, 335.4), (5.0, 930.9)])
def test_cusum_run_length_is_the_published_one(threshold: float, run_length: float) -> None:
    # Montgomery, Introduction to Statistical Quality Control, table 9.3: 168 and 465 for two-sided charts.
    assert 2.0 * cusum_run_length(threshold, 0.5) == pytest.approx(run_length, rel=2e-3)


@pytest.mark.parametrize("std", [1.0, 1.2, 2.0])
@pytest.mark.parametrize(("threshold", "drift"), [(6.0, 0.5), (11.0, 0.5), (14.0, 0.25), (8.0, 0.75)])
def test_cusum_run_length_solves_pages_integral_equation(threshold: float, drift: float, std: float) -> None:
    """L(x) = 1 + L(0) Phi(k - x) + integral of L(y) phi(y - x + k) over 0..h (Page 1954), by Gauss's quadrature."""
    h, k = threshold / std, drift / std
    nodes, weights = (torch.from_numpy(0.5 * h * x) for x in np.polynomial.legendre.leggauss(64))
    y = torch.cat([nodes.new_zeros(1), nodes + 0.5 * h])
    density = torch.exp(-0.5 * (y[None, 1:] - y[:, None] + k).square()) * weights / math.sqrt(2.0 * math.pi)
    stay = torch.cat([torch.special.ndtr(k - y).unsqueeze(1), density], dim=1)
    exact = torch.linalg.solve(torch.eye(len(y), dtype=y.dtype) - stay, torch.ones_like(y))
    assert 2.0 * cusum_run_length(threshold, drift, std) == pytest.approx(float(exact[0]), rel=1e-3)


def test_a_rarely_read_sensor_needs_as_many_of_its_own_readings() -> None:
    """A missing reading changes nothing: neither its own sums nor those of other channels."""
    rare = torch.full((400, 2), torch.nan, dtype=torch.float64)
    rare[::10, 1] = noise(40) + 1.5
    alone, together = cusum(0.5, rare[::10, 1:])[0], cusum(0.5, rare)[0]
    torch.testing.assert_close(together[::10], alone)
    white = whitening_of(
        torch.stack([noise(400), torch.where(torch.arange(400) % 2 == 0, noise(400, seed=1), torch.nan)], 1)
    )
    assert torch.isfinite(white(torch.stack([torch.ones(4), torch.full((4,), torch.nan)], 1).double())[:, 0]).all()


def test_fixed_threshold_shares_the_false_alarms_among_channels() -> None:
    h = known(fixed_rate, 370.4, 1).threshold
    assert h == pytest.approx(3.0, abs=1e-3)
    assert known(fixed_rate, 1000.0, 3).threshold > known(fixed_rate, 1000.0, 1).threshold


@pytest.mark.parametrize("chart", CHARTS)
def test_false_alarms_have_the_designed_rate(chart: Chart) -> None:
    detector = detector_of(chart, 2000.0)
    count = sum(int(detector.alarms(noise(100, 4000, 3, seed=s)).sum()) for s in range(3))
    expected = 3 * 100 * 4000 / 2000.0
    assert abs(count - expected) < 3.0 * math.sqrt(expected) + 0.04 * expected


def test_predictive_threshold_of_one_sample_is_students() -> None:
    """The noise of one channel was learnt from n samples: e has Student's t distribution with n degrees of freedom."""
    learnt = whitening_of(noise(100, 1), 0)
    detector = make_detector("fixed", 1000.0, 1.0, 1, torch.Generator(), learnt=learnt)
    assert detector.threshold == pytest.approx(stats.t.isf(0.5 / 1000.0, df=100), rel=2e-3)


def test_uncertain_flows_give_the_mean_rate_of_a_log_normal_deviation() -> None:
    """By Gauss-Hermite quadrature over ln of the standard deviation of one channel's sums."""
    error = torch.full((1,), 0.3, dtype=torch.float64)
    share = latin_hypercube(1, torch.Generator()).expand(2, -1, -1)
    design = replace(known(fixed_rate, 1000.0, 1), errors=lambda length: (0.0 * error, error), share=share)
    nodes, weights = (torch.from_numpy(x) for x in np.polynomial.hermite_e.hermegauss(60))
    rates = fixed_rate(design.threshold, torch.exp(0.3 * nodes).unsqueeze(1))
    assert float(rates @ weights / weights.sum()) * 1000.0 == pytest.approx(1.0, rel=0.05)


@pytest.mark.parametrize("samples", [300, 3000])
def test_predicted_rates_are_those_of_many_calibrations(samples: int) -> None:
    """Against 2000 calibrations: the rate of max |e| > h is known for every learnt standard deviation."""
    design = make_detector(
        "fixed", 20000.0, 1.0, 3, torch.Generator(), learnt=whitening_of(noise(samples, 3), 0)
    ).design
    std = torch.cat([noise(100, samples, 3, seed=s).square().mean(1).rsqrt() for s in range(20)])
    rates = fixed_rate(design.threshold, std)
    # The mean of 2000 rates is known to 5 %; a share of 95 % to 0.5 %.
    assert float(rates.mean()) * 20000.0 == pytest.approx(1.0, abs=0.15)
    within = (rates > design.quantile(0.025)) & (rates < design.quantile(0.975))
    assert float(within.double().mean()) == pytest.approx(0.95, abs=0.02)


def test_predicted_count_of_known_noise_is_poissons() -> None:
    design = known(fixed_rate, 100.0, 2)
    counts = [design.count_quantile(1000.0, p) for p in (0.025, 0.5, 0.975)]
    assert counts == [int(stats.poisson.ppf(p, 10.0)) for p in (0.025, 0.5, 0.975)]


def test_noise_that_is_hardly_known_has_a_finite_threshold() -> None:
    learnt = replace(whitening_of(noise(400, 2), 0), slow_error=torch.tensor([0.1, 4.0], dtype=torch.float64))
    design = make_detector("cusum", 20000.0, 1.0, 2, torch.Generator(), learnt=learnt).design
    assert 100.0 < design.threshold < math.inf and float(design.rates.mean()) == pytest.approx(1.0 / 20000.0, rel=1e-3)
    assert 1.0 < design.learning_factor(2.0) < math.inf


def test_learning_for_as_long_as_needed_determines_the_rate() -> None:
    for samples in (300, 5000):
        short = make_detector("cusum", 20000.0, 1.0, 3, torch.Generator(), learnt=whitening_of(noise(samples, 3), 0))
        needed = round(samples * short.design.learning_factor(2.0))
        enough = make_detector("cusum", 20000.0, 1.0, 3, torch.Generator(), learnt=whitening_of(noise(needed, 3), 0))
        factor = enough.design.quantile(0.975) / enough.design.quantile(0.025)
        assert math.sqrt(factor) == pytest.approx(2.0, rel=0.05)


def test_a_shift_is_found_sooner_by_cusum_than_by_a_fixed_threshold() -> None:
    shifted = noise(200, 3000, 3)
    shifted[:, 1000:, 1] += 0.7
    delays = {}
    for chart in CHARTS:
        alarms = detector_of(chart, 20000.0).alarms(shifted)
        late = torch.where(alarms.any(dim=1), alarms.to(torch.int8).argmax(dim=1), 3000)
        delays[chart] = float(late[late > 1000].median() - 1000)
    assert delays["cusum"] < 0.5 * delays["fixed"]


def test_cusum_is_pages_recursion() -> None:
    e, drift = noise(50, 2), 0.3
    up = down = torch.zeros(2, dtype=torch.float64)
    for k in range(50):
        up, down = (up + e[k] - drift).clamp(min=0.0), (down - e[k] - drift).clamp(min=0.0)
        assert float(cusum(drift, e)[0][k]) == pytest.approx(float(torch.maximum(up, down).max()), abs=1e-12)


def cusum_of(threshold: float) -> Detector:
    """A CUSUM with that threshold."""
    made = make_detector("cusum", 1000.0, 1.0, 1, torch.Generator())
    return replace(made, design=replace(made.design, chart_rate=lambda h, std: (h < threshold) * std[:, 0]))


def test_an_alarm_restarts_the_detector() -> None:
    e = torch.zeros(20, 1, dtype=torch.float64)
    e[5], e[6], e[12] = 10.0, 10.0, 10.0
    raised = cusum_of(5.0).alarms(e)
    assert raised.nonzero().flatten().tolist() == [5, 6, 12]
    quiet = cusum_of(15.0).alarms(e)
    assert quiet.nonzero().flatten().tolist() == [6]


def test_a_missing_reading_neither_alarms_nor_stops_the_detector() -> None:
    e = torch.zeros(20, 2, dtype=torch.float64)
    e[3:6, 0] = torch.nan
    e[10, 1] = 9.0
    assert make_detector("fixed", 1000.0, 1.0, 2, torch.Generator()).alarms(e).nonzero().flatten().tolist() == [10]


@pytest.mark.parametrize("coefficient", [0.0, 0.8])
def test_coloured_noise_becomes_white(coefficient: float) -> None:
    drive, series = noise(4000, 2), torch.zeros(4000, 2, dtype=torch.float64)
    for k in range(1, 4000):
        series[k] = coefficient * series[k - 1] + drive[k]
    whitening = whitening_of(1e-3 * series + torch.tensor([0.0, 5e-3], dtype=torch.float64))
    assert whitening.order == (1 if coefficient else 0)
    white = whitening(1e-3 * series + torch.tensor([0.0, 5e-3], dtype=torch.float64))[10:]
    torch.testing.assert_close(white.std(0), torch.ones(2, dtype=torch.float64), rtol=0.02, atol=0)
    assert (white[1:] * white[:-1]).mean().abs() < 0.03
    assert float(whitening.mean[1]) == pytest.approx(5e-3, rel=0.1)


def test_the_residual_s_variance_allows_for_the_coefficients_that_it_spends() -> None:
    """An AR(2) model of 64 samples leaves 62 errors and, unbiased, 60 degrees of freedom."""
    drive, series = noise(64, 1), torch.zeros(64, 1, dtype=torch.float64)
    for k in range(2, 64):
        series[k] = 0.5 * series[k - 1] - 0.5 * series[k - 2] + drive[k]
    (whitening,) = (w for _, w in score_whitenings(series, 2) if w.order == 2 and not bool(w.mean.any()))
    assert float(whitening(series)[2:].square().sum()) == pytest.approx(60.0)


def test_what_is_learnt_is_the_same_bit_for_bit_whatever_lies_in_memory() -> None:
    series = torch.randn(800, 3, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    kept, learnt = [], set()
    for k in range(60):
        kept.append(torch.empty(37 * k + 1))
        w = next(w for _, w in score_whitenings(series.clone()) if w.order == 4)
        learnt.add(w.coefficients.numpy().tobytes() + w.whitener.numpy().tobytes())
    assert len(learnt) == 1


def test_channels_that_move_together_are_separated() -> None:
    e = noise(3000, 2)
    mixed = torch.stack([e[:, 0], 0.9 * e[:, 0] + 0.3 * e[:, 1]], dim=1)
    white = whitening_of(mixed)(mixed)
    assert (white[:, 0] * white[:, 1]).mean().abs() < 0.03


def test_an_order_needs_ten_samples_for_each_of_its_coefficients() -> None:
    """Two channels, 60 samples: three orders at most, though what has lasted for five samples would ask for more."""
    drive, series = noise(60, 2), torch.zeros(60, 2, dtype=torch.float64)
    for k in range(60):
        series[k] = drive[k] + (0.9 * series[k - 5] if k >= 5 else 0.0)
    assert max(learnt.order for _, learnt in score_whitenings(series)) == 3


def test_misuse_is_refused() -> None:
    generator = torch.Generator()
    with pytest.raises(ValueError, match="expected a detector of fixed, cusum, got 'cusam'"):
        make_detector("cusam", 1000.0, 1.0, 3, generator)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="at least 20 samples"):
        make_detector("fixed", 10.0, 1.0, 3, generator)
    with pytest.raises(ValueError, match="at least 40 fault-free samples"):
        whitening_of(noise(30, 2))
    with pytest.raises(ValueError, match="none in channel 2"):
        whitening_of(noise(200, 2) * torch.tensor([1.0, 0.0], dtype=torch.float64))


def test_cusum_threshold_is_for_all_channels_together() -> None:
    threshold = known(partial(cusum_rate, drift=0.25), 1000.0, 3).threshold
    assert cusum_run_length(threshold, 0.25) == pytest.approx(3000.0, rel=1e-3)


def test_the_stated_error_of_low_frequency_sums_is_right() -> None:
    """60 fits of an AR(1) of 0.7: the true spread of slow sums about each, beside its stated standard error."""
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randn(60, 1700, 2, generator=generator, dtype=torch.float64)
    coloured = torch.zeros_like(drawn)
    for k in range(1, 1700):
        coloured[:, k] = 0.7 * coloured[:, k - 1] + drawn[:, k]
    off, said = [], []
    for residual in coloured[:, 200:]:
        learnt = whitening_of(residual)
        slow = learnt.whitener @ (torch.eye(2, dtype=torch.float64) - learnt.coefficients.sum(0)) / (1.0 - 0.7)
        off.append(torch.linalg.vector_norm(slow, dim=1).log())
        said.append(learnt.slow_error)
    # 120 values: a standard deviation known to 7 %.
    assert float(torch.stack(off).std()) == pytest.approx(float(torch.stack(said).mean()), rel=0.2)


@pytest.mark.parametrize("chart", CHARTS)
def test_thresholds_allow_for_noise_estimated_from_a_short_recording(chart: Chart) -> None:
    generator = torch.Generator().manual_seed(1)
    long, short = (whitening_of(torch.randn(n, 2, generator=generator, dtype=torch.float64)) for n in (20000, 400))
    designs = [make_detector(chart, 5000.0, 1.0, 2, generator, learnt=w).design for w in (long, short)]
    one = torch.ones(1, 2, dtype=torch.float64)
    sure, unsure = (1.0 / (5000.0 * float(d.chart_rate(d.threshold, one))) for d in designs)
    assert 1.0 < sure < 1.05 < unsure < 2.0


def test_rare_alarms_have_a_threshold() -> None:
    """ln of the run length grows as 2 drift h: some 6 more than at a thousandth of it."""
    for run_length in (1e12, 1e18, 1e300):
        low, high = (known(partial(cusum_rate, drift=0.5), n, 3).threshold for n in (1e-3 * run_length, run_length))
        assert high - low == pytest.approx(math.log(1e3), abs=0.5)
