"""Thresholds against published run lengths, and false alarms on noise with several autocorrelations."""

from __future__ import annotations

import math
from functools import cache

import pytest
import torch
from rigs import whitening_of

from fdi_torch.monitor.detection import (
    CHARTS,
    LONGEST_WINDOW,
    NO_ALARM,
    Chart,
    Detector,
    cusum,
    cusum_update,
    false_alarm_inflation,
    glr,
    log_rate_std,
    make_detector,
    max_abs,
    window_lengths,
)
from fdi_torch.monitor.run_length import (
    block_maxima,
    cusum_run_length,
    cusum_threshold,
    fixed_threshold,
    threshold_from_maxima,
)
from fdi_torch.monitor.whitening import score_whitenings


def noise(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@cache
def glr_peaks() -> torch.Tensor:
    """The simulated maxima on which the thresholds of a GLR of three channels depend."""
    lengths = window_lengths(LONGEST_WINDOW)
    return block_maxima(lambda e: glr(e, lengths), 3, torch.Generator().manual_seed(1))


def detector_of(chart: Chart, time_between_false_alarms: float) -> Detector:
    peaks = glr_peaks() if chart == "glr" else None
    return make_detector(chart, time_between_false_alarms, 1.0, 3, torch.Generator(), peaks=peaks)


@pytest.mark.parametrize(("threshold", "run_length"), [(4.0, 335.4), (5.0, 930.9)])
def test_cusum_run_length_is_the_published_one(threshold: float, run_length: float) -> None:
    # Montgomery, Introduction to Statistical Quality Control, table 9.3: 168 and 465 for two-sided charts.
    assert cusum_run_length(threshold, 0.5) == pytest.approx(run_length, rel=2e-3)


def test_a_rarely_read_sensor_needs_as_many_of_its_own_readings() -> None:
    """A missing reading changes nothing: neither its own sums nor those of other channels."""
    rare = torch.full((400, 2), torch.nan, dtype=torch.float64)
    rare[::10, 1] = noise(40) + 1.5
    alone = cusum(rare[::10, 1:], 0.5)
    torch.testing.assert_close(cusum(rare, 0.5)[::10], alone)
    white = whitening_of(
        torch.stack([noise(400), torch.where(torch.arange(400) % 2 == 0, noise(400, seed=1), torch.nan)], 1)
    )
    assert torch.isfinite(white(torch.stack([torch.ones(4), torch.full((4,), torch.nan)], 1).double())[:, 0]).all()


def test_fixed_threshold_shares_the_false_alarms_among_channels() -> None:
    h = fixed_threshold(370.4, 1)
    assert h == pytest.approx(3.0, abs=1e-3)
    assert fixed_threshold(1000.0, 3) > fixed_threshold(1000.0, 1)


@pytest.mark.parametrize("chart", CHARTS)
def test_false_alarms_have_the_designed_rate(chart: Chart) -> None:
    detector = detector_of(chart, 2000.0)
    count = sum(int(detector.alarms(noise(100, 4000, 3, seed=s)).sum()) for s in range(3))
    expected = 3 * 100 * 4000 / 2000.0
    assert abs(count - expected) < 3.0 * math.sqrt(expected) + 0.04 * expected


def test_error_of_the_false_alarm_rate_learnt_from_one_recording() -> None:
    """Against thresholds learnt from many recordings: the rate of max |e| > h is known for every spread."""
    asked, h = 20000.0, fixed_threshold(20000.0, 3)
    spread = torch.stack([noise(1000, 3, seed=s).square().mean(0).sqrt() for s in range(400)])
    rates = 2.0 * torch.special.ndtr(-h * spread).sum(1)
    claimed = log_rate_std("fixed", asked, 3, 0.5, whitening_of(noise(1000, 3), 0))
    assert claimed == pytest.approx(float(rates.log().std()), rel=0.15)


@pytest.mark.parametrize("chart", CHARTS)
def test_the_first_alarm_since_a_time_is_one_of_all_alarms(chart: Chart) -> None:
    detector = detector_of(chart, 200.0)
    white = noise(40, 1000, 3, seed=5)
    white[:, 600:] += 0.5
    white[3, 700] = torch.nan
    since = torch.arange(40) * 15
    first, early = detector.first_alarm_since(white, since)
    for run, raised in enumerate(detector.alarms(white)):
        moments = raised.nonzero().flatten().tolist()
        assert early[run] == sum(m < since[run] for m in moments)
        assert first[run] == next(m for m in moments if m >= since[run])
    assert detector.first_alarm_since(torch.zeros(1, 50, 3), torch.tensor([0]))[0].tolist() == [NO_ALARM]


def test_simulated_threshold_agrees_with_the_exact_one() -> None:
    found = threshold_from_maxima(block_maxima(max_abs, 3, torch.Generator().manual_seed(0)), 5000.0)
    assert found == pytest.approx(fixed_threshold(5000.0, 3), abs=0.03)


def test_a_shift_is_found_sooner_by_cusum_than_by_a_fixed_threshold() -> None:
    shifted = noise(200, 3000, 3)
    shifted[:, 1000:, 1] += 0.7
    delays = {}
    for chart in CHARTS:
        first = detector_of(chart, 20000.0).first_alarm(shifted)
        late = torch.where(first == NO_ALARM, 3000, first)
        delays[chart] = float(late[late > 1000].median() - 1000)
    assert delays["cusum"] < 0.5 * delays["fixed"] and delays["glr"] < 0.5 * delays["fixed"]


def test_cusum_is_pages_recursion() -> None:
    e, drift = noise(50, 2), 0.3
    up = down = torch.zeros(2, dtype=torch.float64)
    for k in range(50):
        up, down = (up + e[k] - drift).clamp(min=0.0), (down - e[k] - drift).clamp(min=0.0)
        assert float(cusum(e, drift)[k]) == pytest.approx(float(torch.maximum(up, down).max()), abs=1e-12)


@pytest.mark.parametrize(("samples", "k"), [(40, 25), (8, 7)], ids=["within", "a window as long as all samples"])
def test_glr_is_the_largest_normalised_sum(samples: int, k: int) -> None:
    e = noise(samples, 2) + 3.0
    lengths = window_lengths(8)
    expected = max(float(e[k - n + 1 : k + 1].sum(0).square().sum() / n) for n in lengths)
    assert float(glr(e, lengths)[k]) == pytest.approx(expected, rel=1e-12)


def test_glr_false_alarms_with_wrong_variances_average_over_channels() -> None:
    """Windows that exceed the threshold by chance point anywhere: rates drawn channel by channel, by Monte Carlo."""
    learnt = whitening_of(noise(1000, 3), 0)
    direction = noise(200_000, 3, seed=2)
    share = (direction / torch.linalg.vector_norm(direction, dim=1, keepdim=True)).square()
    off = noise(200_000, 3, seed=3) * learnt.slow_error
    # ln of the rate goes as half the threshold, about ln of the run length, times the variance: 2 d.
    rates = torch.exp(2.0 * math.log(20000.0) * (share * off).sum(1))
    claimed = false_alarm_inflation("glr", 20000.0, 3, 0.5, learnt)
    assert claimed - 1.0 == pytest.approx(float(rates.mean()) - 1.0, rel=0.1)


def test_an_alarm_restarts_the_detector() -> None:
    e = torch.zeros(20, 1, dtype=torch.float64)
    e[5], e[6], e[12] = 10.0, 10.0, 10.0
    raised = Detector("cusum", lambda x: cusum(x, 0.5), 5.0, lambda x, _: cusum_update(x, 0.5, None)).alarms(e)
    assert raised.nonzero().flatten().tolist() == [5, 6, 12]
    quiet = Detector("cusum", lambda x: cusum(x, 0.5), 15.0, lambda x, _: cusum_update(x, 0.5, None)).alarms(e)
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
    with pytest.raises(ValueError, match="expected a detector of fixed, cusum, glr, got 'cusam'"):
        make_detector("cusam", 1000.0, 1.0, 3, generator)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="expected a positive drift"):
        make_detector("cusum", 1000.0, 1.0, 3, generator, drift=0.0)
    with pytest.raises(ValueError, match="at least 20 samples"):
        make_detector("fixed", 10.0, 1.0, 3, generator)
    for every in (1e18, 1e300):
        with pytest.raises(ValueError, match=r"below 1.9e\+12 samples"):
            make_detector("cusum", every, 1.0, 3, generator)
    with pytest.raises(ValueError, match="at least one sample"):
        make_detector("glr", 1000.0, 1.0, 3, generator, window=0)
    with pytest.raises(ValueError, match="at least 40 fault-free samples"):
        whitening_of(noise(30, 2))
    with pytest.raises(ValueError, match="none in channel 2"):
        whitening_of(noise(200, 2) * torch.tensor([1.0, 0.0], dtype=torch.float64))


def test_cusum_threshold_is_for_all_channels_together() -> None:
    assert cusum_run_length(cusum_threshold(1000.0, 3, 0.25), 0.25) == pytest.approx(6000.0, rel=1e-3)


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


def test_thresholds_allow_for_noise_estimated_from_a_short_recording() -> None:
    generator = torch.Generator().manual_seed(1)
    long, short = (whitening_of(torch.randn(n, 2, generator=generator, dtype=torch.float64)) for n in (20000, 400))
    for chart in CHARTS:
        sure, unsure = (false_alarm_inflation(chart, 5000.0, 2, 0.5, learnt) for learnt in (long, short))
        assert 1.0 < sure < 1.05 < unsure < 2.0
    known, doubted = (make_detector("cusum", 5000.0, 1.0, 2, generator, learnt=w) for w in (None, short))
    assert doubted.threshold > known.threshold


def test_the_longest_allowed_run_length_has_a_threshold() -> None:
    """ln of the run length grows as 2 drift h: some 6 more than at a thousandth of it."""
    low, high = (cusum_threshold(n, 3, 0.5) for n in (1e9, 1e12))
    assert high - low == pytest.approx(math.log(1e3), abs=0.5)
