"""State noise against dense multivariate normals, central differences, and the truth of simulated disturbances."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from fdi_torch.estimate.kalman import KalmanFilter, Propagation
from fdi_torch.estimate.noise_model import SensorNoise, StateNoise, Wander
from fdi_torch.estimate.state_noise import _Problem, estimate_state_noise

DOUBLE = torch.float64
WHITE = torch.zeros(2, dtype=DOUBLE)
COLOURED = torch.tensor([0.6, 0.6], dtype=DOUBLE)
STD = torch.tensor([1e-3, 2e-3], dtype=DOUBLE)
INTENSITY = torch.tensor([3e-6, 1e-6], dtype=DOUBLE)  # m^3/s: per second 0.2 and 0.07 mm in tanks of 154 cm^2
AREA = 0.0154


def two_tanks(
    samples: int, fresh: tuple[int, ...] = (0,), masked: float = 0.0, intervals: Tensor | None = None
) -> Propagation:
    """Two tanks joined by a pipe, the second one drained; both levels are read each second or after these intervals."""
    rates = torch.tensor([[-0.02, 0.02], [0.02, -0.05]], dtype=DOUBLE)
    steps = torch.ones(samples, dtype=DOUBLE) if intervals is None else intervals
    transition = torch.matrix_exp(rates * steps[:, None, None])
    forcing = torch.linalg.solve(rates, transition - torch.eye(2, dtype=DOUBLE)) / AREA
    starts = torch.zeros(samples, dtype=torch.bool)
    starts[list(fresh)] = True
    seen = torch.rand(samples, 2, generator=torch.Generator().manual_seed(9)) >= masked
    output = torch.eye(2, dtype=DOUBLE).repeat(samples, 1, 1)
    return Propagation(transition, forcing, output, steps, fresh=starts, mask=seen)


def uneven(samples: int, fresh: tuple[int, ...] = (0,), masked: float = 0.0) -> Propagation:
    """The same tanks, read every 0.2 to 20 s."""
    steps = torch.exp(4.6 * torch.rand(samples, generator=torch.Generator().manual_seed(5), dtype=DOUBLE)) / 5.0
    return two_tanks(samples, fresh, masked, steps)


TANKS = pytest.mark.parametrize("tanks", [two_tanks, uneven], ids=["even", "uneven"])


def correlation_of(noise: StateNoise) -> float:
    return math.exp(-1.0 / noise.correlation_time) if noise.correlation_time else 0.0


def flow_factors(p: Propagation, time: float) -> Tensor:
    """Standard deviations (S,) of a flow over each interval, that over the usual one being 1: the variance of its
    integral over many intervals dt is dt coth(dt / 2 tau) per second."""

    def variance(dt: float) -> float:
        return dt / math.tanh(0.5 * dt / time) if time else dt

    usual = variance(sorted(p.interval.tolist())[(len(p.interval) - 1) // 2])
    return torch.tensor([math.sqrt(usual / variance(dt)) for dt in p.interval.tolist()], dtype=DOUBLE)


def simulated(p: Propagation, sensors: SensorNoise, noise: StateNoise, seed: int) -> Tensor:
    """Residuals (S, C) of levels that random flows move, read with noise."""
    generator = torch.Generator().manual_seed(seed)
    keep, a = correlation_of(noise), sensors.correlation
    std = noise.scale * sensors.std

    def normal() -> Tensor:
        return torch.randn(2, generator=generator, dtype=DOUBLE)

    rows = []
    for s in range(len(p.mask)):
        if bool(p.fresh[s]):
            level, flow, error = torch.zeros(2, dtype=DOUBLE), noise.intensity * normal(), std * normal()
        rows.append(p.output[s] @ level + error)
        level = p.transition[s] @ level + p.forcing[s] @ flow
        flow = keep * flow + math.sqrt(1.0 - keep**2) * noise.intensity * normal()
        error = a * error + torch.sqrt(1.0 - a**2) * std * normal()
    return torch.where(p.mask, torch.stack(rows), 0.0)


def dense(p: Propagation, sensors: SensorNoise, noise: StateNoise) -> tuple[Tensor, Tensor]:
    """Covariance of all readings (S C, S C), and of the levels (S n) with the readings, of one recording."""
    samples, keep, factor = len(p.mask), correlation_of(noise), flow_factors(p, noise.correlation_time)
    count, times = torch.arange(samples, dtype=DOUBLE), torch.cat([torch.zeros(1), p.interval[:-1].cumsum(0)])
    gap, apart = ((x.unsqueeze(0) - x.unsqueeze(1)).abs() for x in (times, count))
    of_flows = (factor * factor.unsqueeze(1) * (keep**gap if keep else torch.eye(samples, dtype=DOUBLE)))[
        :, None, :, None
    ] * torch.diag(noise.intensity**2).reshape(1, 2, 1, 2)
    response = torch.zeros(samples, 2, samples, 2, dtype=DOUBLE)  # levels at s by flows at r
    for s in range(1, samples):
        response[s] = torch.einsum("ij,jrk->irk", p.transition[s - 1], response[s - 1])
        response[s, :, s - 1] += p.forcing[s - 1]
    flat = response.reshape(2 * samples, 2 * samples)
    of_levels = flat @ of_flows.reshape(2 * samples, 2 * samples) @ flat.T
    std = noise.scale * sensors.std
    of_errors = torch.diag_embed(std**2 * sensors.correlation ** apart.unsqueeze(-1))
    if noise.wander:
        of_errors[:, :, noise.wander.channel, noise.wander.channel] += drift_covariance(noise.wander, gap)
    of_errors = of_errors.permute(0, 2, 1, 3).reshape(2 * samples, 2 * samples)
    return of_levels + of_errors, of_levels


def drift_covariance(drift: Wander, gap: Tensor) -> Tensor:
    """Matern covariances of order 1/2 and, for a smooth drift, 3/2 (Rasmussen and Williams, 2006, section 4.2.1)."""
    x = gap / drift.correlation_time
    return drift.std**2 * (1.0 + x if drift.smooth else 1.0) * torch.exp(-x)


def problem(p: Propagation, sensors: SensorNoise, residual: Tensor, columns: int = 0) -> _Problem:
    """columns: linear parameters beside the noise, with priors of unit width."""
    jacobian = torch.randn(*residual.shape, columns, generator=torch.Generator().manual_seed(4), dtype=DOUBLE) * 1e-3
    pull = torch.ones(columns, dtype=DOUBLE)
    return _Problem(p, sensors, residual, jacobian, pull, 0.3 * pull, INTENSITY)


def one_order_of_magnitude(noise: StateNoise) -> float:
    """Log prior of two intensities: their logarithms differ from the mean by half of their difference each."""
    first, second = torch.log(noise.intensity).tolist()
    return -((0.5 * (first - second) / math.log(2.0)) ** 2)


@TANKS
@pytest.mark.parametrize("time", [0.0, 15.0])
@pytest.mark.parametrize("correlation", [WHITE, COLOURED], ids=["white", "coloured"])
@pytest.mark.parametrize("masked", [0.0, 0.3])
def test_the_likelihood_is_that_of_a_dense_normal_distribution(
    tanks: Callable[..., Propagation], time: float, correlation: Tensor, masked: float
) -> None:
    p, sensors = tanks(12, masked=masked), SensorNoise(STD, correlation)
    noise = StateNoise(INTENSITY, time, torch.tensor([1.0, 1.3], dtype=DOUBLE))
    residual, seen = simulated(p, sensors, noise, 1), p.mask.flatten()
    covariance = dense(p, sensors, noise)[0][seen][:, seen]
    y = residual.flatten()[seen]
    expected = -0.5 * float(y @ torch.linalg.solve(covariance, y)) - 0.5 * float(torch.logdet(covariance))
    value, _ = problem(p, sensors, residual).likelihood(noise)
    assert value == pytest.approx(expected + one_order_of_magnitude(noise), rel=1e-9)
    white = KalmanFilter(p, sensors).under(noise)
    assert white.log_det == pytest.approx(float(torch.logdet(covariance)), rel=1e-9)
    squares = float(y @ torch.linalg.solve(covariance, y))
    assert float(white(residual).square().sum()) == pytest.approx(squares, rel=1e-9)


@TANKS
@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("correlation", [WHITE, COLOURED], ids=["white", "coloured"])
def test_a_sensor_that_wanders_has_the_likelihood_of_a_dense_normal_distribution(
    tanks: Callable[..., Propagation], correlation: Tensor, smooth: bool
) -> None:
    p, sensors = tanks(12, masked=0.3), SensorNoise(STD, correlation)
    noise = StateNoise(INTENSITY, 15.0, torch.tensor([1.0, 1.3], dtype=DOUBLE), Wander(1, 4e-3, 6.0, smooth))
    residual, seen = simulated(p, sensors, noise, 1), p.mask.flatten()
    covariance = dense(p, sensors, noise)[0][seen][:, seen]
    y = residual.flatten()[seen]
    expected = -0.5 * float(y @ torch.linalg.solve(covariance, y)) - 0.5 * float(torch.logdet(covariance))
    value, _ = problem(p, sensors, residual).likelihood(noise)
    assert value == pytest.approx(expected + one_order_of_magnitude(noise), abs=1e-6)  # nats


@TANKS
@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("correlation", [WHITE, COLOURED], ids=["white", "coloured"])
def test_the_slope_by_a_wander_is_a_central_difference(
    tanks: Callable[..., Propagation], correlation: Tensor, smooth: bool
) -> None:
    p, sensors = tanks(80, masked=0.2), SensorNoise(STD, correlation)
    noise = StateNoise(INTENSITY, 15.0, torch.ones(2, dtype=DOUBLE), Wander(0, 3e-3, 20.0, smooth))
    whole = problem(p, sensors, simulated(p, sensors, noise, 3), columns=2)

    def value(log: float) -> float:
        return whole.likelihood(replace(noise, wander=Wander(0, 3e-3 * math.exp(log), 20.0, smooth)))[0]

    expected = (value(1e-4) - value(-1e-4)) / 2e-4
    assert float(whole.likelihood(noise)[1].slope[-1]) == pytest.approx(expected, rel=1e-5, abs=1e-5)


@TANKS
@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("time", [1.0, 20.0, 320.0])
def test_a_wander_keeps_its_variance_from_the_first_sample_on(
    tanks: Callable[..., Propagation], smooth: bool, time: float
) -> None:
    a, b = KalmanFilter(tanks(200), SensorNoise(STD, WHITE)).drift(Wander(0, 1.0, time, smooth))
    covariance = torch.eye(a.shape[-1], dtype=DOUBLE)
    for transition, forcing in zip(a, b, strict=True):
        covariance = transition @ covariance @ transition.T + forcing @ forcing.T
        torch.testing.assert_close(covariance, torch.eye(len(covariance), dtype=DOUBLE), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("time", [0.0, 5.0, 80.0])
def test_random_flows_move_as_much_water_whatever_the_times_between_samples(time: float) -> None:
    """Variance of the volume after 8000 s, from samples every 1 s, every 10 s, and first every 1, then every 10 s."""
    both = torch.cat([torch.ones(4000, dtype=DOUBLE), torch.full((400,), 10.0, dtype=DOUBLE)])
    moved = []
    for steps in (torch.ones(8000, dtype=DOUBLE), torch.full((800,), 10.0, dtype=DOUBLE), both):
        p = two_tanks(8001 + len(steps), intervals=torch.cat([torch.ones(8001, dtype=DOUBLE), steps]))  # usually 1 s
        model = KalmanFilter(p, SensorNoise(STD, WHITE))
        held = p.interval * model.forced(time)[1][:, 0, 0] / p.forcing[:, 0, 0]
        volume, together = 0.0, 0.0  # its variance, and its covariance with the flow
        for k, f in zip(model.kept(time)[8001:].tolist(), held[8001:].tolist(), strict=True):
            volume, together = volume + 2.0 * f * together + f * f, k * (together + f)
        moved.append(volume / 8000.0)
    assert moved == pytest.approx([moved[0]] * 3, rel=0.02)


@pytest.mark.parametrize("correlation", [WHITE, COLOURED], ids=["white", "coloured"])
def test_the_order_of_recordings_with_other_intervals_is_irrelevant(correlation: Tensor) -> None:
    sensors, noise = SensorNoise(STD, correlation), StateNoise(INTENSITY, 20.0, torch.ones(2, dtype=DOUBLE))
    noise = replace(noise, wander=Wander(1, 3e-3, 40.0, smooth=True))
    each = [(torch.ones(40, dtype=DOUBLE), 6), (torch.full((30,), 10.0, dtype=DOUBLE), 7)]
    told = []
    for (first, a), (second, b) in (each, each[::-1]):
        p = two_tanks(70, (0, len(first)), intervals=torch.cat([first, second]))
        alone = (
            simulated(two_tanks(len(steps), intervals=steps), sensors, noise, s)
            for steps, s in ((first, a), (second, b))
        )
        told.append(problem(p, sensors, torch.cat(list(alone))).likelihood(noise)[0])
    assert told[0] == pytest.approx(told[1], rel=1e-12)


@pytest.mark.parametrize("channel", [0, 1])
def test_what_a_sensor_wanders_by_is_told_from_random_flows(channel: int) -> None:
    """A reading that wanders by 5 mm over 80 s, on a rig without random flows: size, and more likely than any flows."""
    p, sensors = two_tanks(3000), SensorNoise(STD, WHITE)
    still = StateNoise(torch.zeros(2, dtype=DOUBLE), 0.0, torch.ones(2, dtype=DOUBLE))
    residual = simulated(p, sensors, still, 31)
    generator, error, keep = torch.Generator().manual_seed(32), 0.0, math.exp(-1.0 / 80.0)
    for row in residual:
        row[channel] += error
        shock = float(torch.randn(1, generator=generator, dtype=DOUBLE))
        error = keep * error + math.sqrt(1.0 - keep**2) * 5e-3 * shock
    whole = problem(p, sensors, residual)
    given = (p, sensors, residual, whole.jacobian, whole.pull, whole.off, INTENSITY)
    flows = estimate_state_noise(*given)
    start = replace(still, intensity=0.01 * INTENSITY, wander=Wander(channel, 2e-3, 20.0))
    found = estimate_state_noise(*given, start=start)
    wander = found.noise.wander
    assert (
        wander is not None and wander.std == pytest.approx(5e-3, rel=0.5) and wander.correlation_time in (80.0, 320.0)
    )
    assert not wander.smooth and found.log_likelihood > flows.log_likelihood + 50.0


def test_a_zero_that_follows_the_temperature_is_a_smooth_wander() -> None:
    p, sensors = two_tanks(3000), SensorNoise(STD, WHITE)
    still = StateNoise(torch.zeros(2, dtype=DOUBLE), 0.0, torch.ones(2, dtype=DOUBLE))
    residual = simulated(p, sensors, still, 31)
    phase = 2.0 * math.pi * torch.arange(3000, dtype=DOUBLE) / 1000.0
    residual[:, 1] += 6e-3 * (torch.sin(phase) + torch.sin(phase / 0.618 + 1.0))
    whole = problem(p, sensors, residual)
    given = (p, sensors, residual, whole.jacobian, whole.pull, whole.off, INTENSITY)
    start = replace(still, intensity=0.01 * INTENSITY, wander=Wander(1, 2e-3, 80.0))
    smooth, rough = (estimate_state_noise(*given, start=start), whole.solve(start))
    assert smooth.noise.wander is not None and smooth.noise.wander.smooth
    assert smooth.log_likelihood > rough.log_likelihood + 100.0


@pytest.mark.parametrize("masked", [0.0, 0.3])
def test_the_likelihood_is_that_of_readings_to_which_random_parameters_add(masked: float) -> None:
    p, sensors = two_tanks(12, masked=masked), SensorNoise(STD, COLOURED)
    noise = StateNoise(INTENSITY, 15.0, torch.ones(2, dtype=DOUBLE))
    whole, seen = problem(p, sensors, simulated(p, sensors, noise, 2), columns=3), p.mask.flatten()
    whole = replace(whole, pull=torch.tensor([1.0, 0.5, 3.0], dtype=DOUBLE))
    j, y = (x.flatten(0, 1)[seen] for x in (whole.jacobian, whole.residual.unsqueeze(-1)))
    scaled = j / whole.pull
    covariance = dense(p, sensors, noise)[0][seen][:, seen] + scaled @ scaled.T
    off = y.squeeze(1) + scaled @ whole.off  # their means are -off / pull
    expected = -0.5 * float(off @ torch.linalg.solve(covariance, off)) - 0.5 * float(torch.logdet(covariance))
    expected += one_order_of_magnitude(noise) - float(torch.log(whole.pull).sum())
    assert whole.likelihood(noise)[0] == pytest.approx(expected, rel=1e-9)


@TANKS
@pytest.mark.parametrize("time", [0.0, 15.0])
@pytest.mark.parametrize("correlation", [WHITE, COLOURED], ids=["white", "coloured"])
@pytest.mark.parametrize(("fresh", "masked", "apart"), [((0,), 0.0, None), ((0,), 0.3, 1), ((0, 35), 0.0, None)])
@pytest.mark.parametrize("pull", [1.0, 0.0], ids=["prior", "no prior"])
def test_slopes_are_central_differences(
    tanks: Callable[..., Propagation],
    time: float,
    correlation: Tensor,
    fresh: tuple[int, ...],
    masked: float,
    apart: int | None,
    pull: float,
) -> None:
    p, sensors = tanks(80, fresh, masked), SensorNoise(STD, correlation)
    noise = StateNoise(INTENSITY, time, torch.tensor([0.9, 1.2], dtype=DOUBLE), apart=apart)
    whole = problem(p, sensors, simulated(p, sensors, noise, 3), columns=2)
    whole = replace(whole, pull=torch.tensor([1.0, pull], dtype=DOUBLE))
    log = torch.zeros(4, dtype=DOUBLE)

    def value(log: Tensor) -> float:
        factor = torch.exp(log)
        moved = replace(noise, intensity=noise.intensity * factor[:2], scale=noise.scale * factor[2:])
        return whole.likelihood(moved)[0]

    step = 1e-4 * torch.eye(4, dtype=DOUBLE)
    expected = [(value(log + h) - value(log - h)) / 2e-4 for h in step]
    assert whole.likelihood(noise)[1].slope.tolist() == pytest.approx(expected, rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("time", [0.0, 15.0])
def test_innovations_under_the_true_noise_are_white_and_of_unit_variance(time: float) -> None:
    p, sensors = two_tanks(4000, (0, 1500), 0.1), SensorNoise(STD, COLOURED)
    noise = StateNoise(INTENSITY, time, torch.ones(2, dtype=DOUBLE))
    white = KalmanFilter(p, sensors).under(noise)(simulated(p, sensors, noise, 5))
    assert float(white[~p.mask].abs().max()) == 0.0
    assert float(white[p.mask].square().mean()) == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / 7200))
    for lag in (1, 2, 10):
        both = p.mask[lag:] & p.mask[:-lag]
        products = (white[lag:] * white[:-lag])[both]
        assert float(products.mean()) == pytest.approx(0.0, abs=4.0 / math.sqrt(int(both.sum())))
    apart = (white[:, 0] * white[:, 1])[p.mask.all(dim=1)]
    assert float(apart.mean()) == pytest.approx(0.0, abs=4.0 / math.sqrt(len(apart)))


def test_a_recording_is_whitened_as_if_it_were_alone() -> None:
    sensors, noise = SensorNoise(STD, COLOURED), StateNoise(INTENSITY, 15.0, torch.ones(2, dtype=DOUBLE))
    y = simulated(two_tanks(90, (0, 40)), sensors, noise, 6)
    together = KalmanFilter(two_tanks(90, (0, 40)), sensors).under(noise)
    pieces = [KalmanFilter(two_tanks(n), sensors).under(noise) for n in (40, 50)]
    expected = torch.cat([piece(part) for piece, part in zip(pieces, (y[:40], y[40:]), strict=True)])
    torch.testing.assert_close(together(y), expected, rtol=1e-9, atol=1e-12)
    assert together.log_det == pytest.approx(sum(piece.log_det for piece in pieces), rel=1e-12)


def test_lanes_and_columns_are_whitened_alike() -> None:
    p, sensors = two_tanks(30, masked=0.2), SensorNoise(STD, COLOURED)
    whitening = KalmanFilter(p, sensors).under(StateNoise(INTENSITY, 5.0, torch.ones(2, dtype=DOUBLE)))
    x = torch.randn(3, 30, 2, 4, generator=torch.Generator().manual_seed(1), dtype=DOUBLE)
    white = whitening(x)
    for lane in range(3):
        torch.testing.assert_close(whitening(x[lane, ..., 1]), white[lane, ..., 1], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(whitening(x[..., 0]), white[..., 0], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("correlation", [WHITE, COLOURED], ids=["white", "coloured"])
@pytest.mark.parametrize("columns", [1, 3, 40])
def test_what_is_transposed_has_the_same_products(correlation: Tensor, columns: int) -> None:
    p, sensors = two_tanks(90, (0, 40), masked=0.2), SensorNoise(STD, correlation)
    whitening = KalmanFilter(p, sensors).under(StateNoise(INTENSITY, 5.0, torch.ones(2, dtype=DOUBLE)))
    y, v = torch.randn(2, 90, 2, columns, generator=torch.Generator().manual_seed(3), dtype=DOUBLE)
    products = (whitening(y) * v).sum((0, 1))
    torch.testing.assert_close((y * whitening.transposed(v)).sum((0, 1)), products, rtol=1e-9, atol=1e-9)


@TANKS
@pytest.mark.parametrize("time", [0.0, 15.0])
@pytest.mark.parametrize("correlation", [WHITE, COLOURED], ids=["white", "coloured"])
def test_smoothed_levels_are_the_dense_conditional_mean(
    tanks: Callable[..., Propagation], time: float, correlation: Tensor
) -> None:
    p, sensors = tanks(12, masked=0.2), SensorNoise(STD, correlation)
    noise = StateNoise(INTENSITY, time, torch.ones(2, dtype=DOUBLE))
    residual, seen = simulated(p, sensors, noise, 7), p.mask.flatten()
    readings, levels = dense(p, sensors, noise)
    expected = levels[:, seen] @ torch.linalg.solve(readings[seen][:, seen], residual.flatten()[seen])
    found = KalmanFilter(p, sensors).under(noise).smoothed(residual)
    torch.testing.assert_close(found.flatten(), expected, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("time", [0.0, 15.0])
@pytest.mark.parametrize("correlation", [WHITE, COLOURED], ids=["white", "coloured"])
def test_predicted_levels_are_the_dense_conditional_mean_of_earlier_readings(time: float, correlation: Tensor) -> None:
    p, sensors = two_tanks(12, masked=0.2), SensorNoise(STD, correlation)
    noise = StateNoise(INTENSITY, time, torch.ones(2, dtype=DOUBLE))
    residual = simulated(p, sensors, noise, 7)
    readings, levels = dense(p, sensors, noise)
    predicted = KalmanFilter(p, sensors).under(noise).predicted(residual)
    for s in range(12):
        earlier = (p.mask & (torch.arange(12) < s).unsqueeze(1)).flatten()
        weights = torch.linalg.solve(readings[earlier][:, earlier], residual.flatten()[earlier])
        torch.testing.assert_close(predicted[s], levels[2 * s : 2 * s + 2, earlier] @ weights, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize(("time", "seed"), [(0.0, 11), (15.0, 12), (60.0, 13)])
def test_disturbances_are_found_with_their_size(time: float, seed: int) -> None:
    p, sensors = two_tanks(3000), SensorNoise(STD, WHITE)
    truth = StateNoise(INTENSITY, time, torch.ones(2, dtype=DOUBLE))
    residual = simulated(p, sensors, truth, seed)
    whole = problem(p, sensors, residual)
    far = StateNoise(4.0 * INTENSITY, time, torch.full((2,), 0.5, dtype=DOUBLE))
    found = whole.solve(far)
    assert found.converged
    ratio = torch.cat([found.noise.intensity / truth.intensity, found.noise.scale])
    allowed = torch.maximum(3.0 * standard_errors(whole, found.noise), torch.tensor(0.15))
    assert bool(((ratio - 1.0).abs() < allowed).all()), ratio


@pytest.mark.parametrize(
    ("time", "chosen", "seed"), [(0.0, (0.0,), 11), (15.0, (5.0, 20.0), 12), (60.0, (20.0, 80.0), 13)]
)
def test_the_correlation_time_is_the_nearest_of_the_candidates(
    time: float, chosen: tuple[float, ...], seed: int
) -> None:
    p, sensors = two_tanks(3000), SensorNoise(STD, WHITE)
    truth = StateNoise(INTENSITY, time, torch.ones(2, dtype=DOUBLE))
    residual = simulated(p, sensors, truth, seed)
    whole = problem(p, sensors, residual)
    found = estimate_state_noise(p, sensors, residual, whole.jacobian, whole.pull, whole.off, INTENSITY)
    assert found.converged and found.noise.correlation_time in chosen
    assert found.log_likelihood > whole.likelihood(truth)[0] - 1.0


@pytest.mark.parametrize("start_time", [0.0, 15.0, 400.0])
def test_disturbances_are_found_from_a_start_without_any(start_time: float) -> None:
    """Such a start is the noise of another explanation, one that needs no random flows."""
    p, sensors, ones = two_tanks(1000), SensorNoise(STD, WHITE), torch.ones(2, dtype=DOUBLE)
    truth = StateNoise(INTENSITY, 15.0, ones)
    residual = simulated(p, sensors, truth, 1)
    whole = problem(p, sensors, residual)
    start = StateNoise(1e-6 * INTENSITY, start_time, ones)
    parts = residual, whole.jacobian, whole.pull, whole.off, INTENSITY
    found = estimate_state_noise(p, sensors, *parts, start)
    assert found.log_likelihood > whole.likelihood(truth)[0] - 1.0


def test_slow_flows_are_found_beside_parameters_whose_effects_are_as_slow() -> None:
    """40 recordings of 300 s, steady flows of unknown size into both tanks."""
    p, sensors, ones = two_tanks(300), SensorNoise(STD, WHITE), torch.ones(2, dtype=DOUBLE)
    truth, generator = StateNoise(INTENSITY, 60.0, ones), torch.Generator().manual_seed(20261580)
    response = torch.stack([torch.linalg.matrix_power(p.transition[0], k) @ p.forcing[0] for k in range(300)])
    steady = 5.0 * INTENSITY * torch.cat([torch.zeros(1, 2, 2, dtype=DOUBLE), response[:-1].cumsum(0)])
    errors: list[Tensor] = []
    for seed in range(40):
        residual = simulated(p, sensors, truth, 20261580 + seed)
        residual = residual + steady @ torch.randn(2, generator=generator, dtype=DOUBLE)
        likely = estimate_state_noise(p, sensors, residual, steady, ones, 0.0 * ones, INTENSITY, truth, climb=False)
        errors.append(torch.log(likely.noise.intensity / INTENSITY).mean())
    average = torch.stack(errors)
    assert abs(float(average.mean())) < 3.0 * float(average.std()) / math.sqrt(40)


def test_readings_that_are_not_finite_have_no_likelihood() -> None:
    """A candidate whose simulation fails costs no other one."""
    p, sensors = two_tanks(12), SensorNoise(STD, WHITE)
    noise = StateNoise(INTENSITY, 15.0, torch.ones(2, dtype=DOUBLE))
    whole = problem(p, sensors, simulated(p, sensors, noise, 2), columns=3)
    broken = replace(whole, jacobian=torch.where(whole.jacobian > 0.0, torch.inf, whole.jacobian))
    assert math.isnan(broken.likelihood(noise)[0]) and math.isfinite(whole.likelihood(noise)[0])


def test_intensities_are_tied_except_for_one_apart() -> None:
    together, apart = (
        StateNoise(INTENSITY * torch.tensor([1.0, 50.0]), 15.0, torch.ones(2), apart=k) for k in (None, 1)
    )
    assert together.log_prior() == pytest.approx(-((0.5 * math.log2(50.0 / 3.0)) ** 2)) and apart.log_prior() == 0.0
    assert float(together.scatter().sum()) == pytest.approx(0.0, abs=1e-12)


def standard_errors(whole: _Problem, noise: StateNoise) -> Tensor:
    """Of the logarithms of intensities and scales, by differences of the slopes."""
    step, rows = 1e-3, []
    for h in step * torch.eye(4, dtype=DOUBLE):
        up, down = (
            replace(noise, intensity=noise.intensity * torch.exp(t * h[:2]), scale=noise.scale * torch.exp(t * h[2:]))
            for t in (1.0, -1.0)
        )
        rows.append((whole.likelihood(up)[1].slope - whole.likelihood(down)[1].slope) / (2.0 * step))
    return torch.sqrt(torch.diagonal(torch.linalg.inv(-torch.stack(rows))))


def test_a_plant_without_disturbances_shows_none_that_matter() -> None:
    """What is estimated moves the levels over the recording by less than the sensors' noise."""
    p, sensors = two_tanks(2000), SensorNoise(STD, WHITE)
    still = StateNoise(torch.zeros(2, dtype=DOUBLE), 0.0, torch.ones(2, dtype=DOUBLE))
    residual = simulated(p, sensors, still, 21)
    whole = problem(p, sensors, residual)
    found = estimate_state_noise(p, sensors, residual, whole.jacobian, whole.pull, whole.off, INTENSITY)
    moved = KalmanFilter(p, sensors).under(found.noise).smoothed(residual)
    assert float(moved.square().mean(dim=0).sqrt().max()) < 2e-4
    assert found.noise.scale.tolist() == pytest.approx([1.0, 1.0], abs=0.06)
