"""Missing readings beside random flows: the other sensors' residuals stay white, with unit variance."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from scipy.stats import poisson
from test_monitor import INPUTS, NETWORK, SPACE, followed, monitor, recorded, step_to
from torch import Tensor

from fdi_torch.estimate.noise_model import StateNoise
from fdi_torch.monitor.detection import make_detector
from fdi_torch.monitor.flow_filter import FlowFilter
from fdi_torch.monitor.noise_model import learn_noise
from fdi_torch.monitor.observer import Observer
from fdi_torch.monitor.observer_gain import Linear, hand_gain
from fdi_torch.monitor.whitening import Whitening

COUNT = 8000
CORRELATIONS = (0.0, 0.7)
PATTERNS = ("dead", "intermittent", "rarely", "never", "all")
TRANSITION = np.array([[0.97, 0.0, 0.02], [0.0, 0.95, 0.02], [0.02, 0.02, 0.96]])
OUTPUT = np.array([[1.0, 0.0, 0.0], [0.0, 100.0, 0.0], [0.0, 0.0, 1.0]])
OBSERVER = np.array([[0.3, 0.0, 0.05], [0.0, 2e-3, 0.0], [0.02, 0.0, 0.4]])
FLOW, KEEP, READING, START = np.array([1e-3, 5e-4, 2e-3]), 0.9, np.array([1e-3, 0.1, 2e-3]), 0.5


def flow_filter(correlation: float) -> FlowFilter:
    none = torch.zeros(0, 3, dtype=torch.float64)
    flow, reading, start, a, h, gain = map(
        torch.from_numpy, (FLOW, READING, START * np.ones(3), TRANSITION, OUTPUT, OBSERVER)
    )
    noise = StateNoise(flow, -1.0 / math.log(KEEP), torch.ones_like(flow))
    rest = none, none.unsqueeze(-1)[..., :0], none[0:0, 0]
    return FlowFilter(Linear(a, h), noise, reading, hand_gain(gain), start, 1.0, *rest, correlation=correlation)


def whitening(correlation: float) -> Whitening:
    """That of the model itself."""
    flows = flow_filter(correlation)
    h = flows.joint.output
    root = torch.linalg.cholesky(h @ flows.covariance @ h.mT + torch.diag(flows.white_std**2))
    zero = torch.zeros(3, dtype=torch.float64)
    return Whitening(zero, torch.zeros(0, 3, 3, dtype=torch.float64), torch.linalg.inv(root), 10**9, zero, flows)


def is_read(pattern: str) -> np.ndarray:
    row = np.arange(COUNT)
    read = np.ones((COUNT, 3), dtype=bool)
    if pattern == "dead":
        read[200:, 0] = False
    elif pattern == "intermittent":
        read[:, 0], read[:, 2] = row % 130 < 50, row % 700 < 650
    elif pattern == "rarely":
        read = np.random.default_rng(5).random((COUNT, 3)) < 0.3
    elif pattern == "never":
        read[:, 1] = False
    return read


@cache
def residuals(pattern: str, correlation: float) -> Tensor:
    """Residuals (COUNT, 3) of the observer with missing readings, by the equations of the model."""
    generator, read = np.random.default_rng(11), is_read(pattern)
    q, p, white = (generator.standard_normal((COUNT, 3)) for _ in range(3))
    x, w, v = START * generator.standard_normal(3), FLOW * generator.standard_normal(3), READING * p[0]
    held = 0.5 * (np.eye(3) + TRANSITION)
    share, out = 1e-3 if correlation else 0.0, np.full((COUNT, 3), np.nan)
    for k in range(COUNT):
        residual = np.where(read[k], OUTPUT @ x + v + share * READING * white[k], 0.0)
        out[k, read[k]] = residual[read[k]]
        x = TRANSITION @ (x - OBSERVER @ residual) + held @ w
        w = KEEP * w + math.sqrt(1.0 - KEEP**2) * FLOW * q[k]
        v = correlation * v + math.sqrt(1.0 - correlation**2) * READING * p[(k + 1) % COUNT]
    return torch.from_numpy(out)


def reference(residual: np.ndarray, correlation: float) -> np.ndarray:
    """Innovations divided by the Cholesky factor of their covariance: the textbook's filter for the present readings,
    from the start on. State: error of the observer, flows, noise of the sensors.
    """
    eye, zero = np.eye(3), np.zeros((3, 3))
    f = np.block(
        [
            [TRANSITION, 0.5 * (eye + TRANSITION), zero],
            [zero, KEEP * eye, zero],
            [zero, zero, correlation * eye],
        ]
    )
    share = 1e-3 if correlation else 0.0
    h, r = np.hstack([OUTPUT, zero, eye]), np.diag((share * READING) ** 2)
    shocks = (1.0 - KEEP**2) * FLOW**2, (1.0 - correlation**2) * READING**2
    q = np.diag(np.concatenate([np.zeros(3), *shocks]))
    state, covariance = np.zeros(9), np.diag(np.concatenate([np.full(3, START**2), FLOW**2, READING**2]))
    white = np.full_like(residual, np.nan)
    for k, row in enumerate(residual):
        p = np.isfinite(row)
        known = np.where(p, row, 0.0)
        if p.any():
            s = h[p] @ covariance @ h[p].T + r[np.ix_(p, p)]
            gain = np.linalg.solve(s, h[p] @ covariance).T
            error = row[p] - h[p] @ state
            white[k, p] = np.linalg.solve(np.linalg.cholesky(s), error)
            state, keep = state + gain @ error, np.eye(9) - gain @ h[p]
            covariance = keep @ covariance @ keep.T + gain @ r[np.ix_(p, p)] @ gain.T
        state[:3] -= OBSERVER @ known
        state, covariance = f @ state, f @ covariance @ f.T + q
    return white


@pytest.mark.parametrize("correlation", CORRELATIONS)
@pytest.mark.parametrize("pattern", PATTERNS)
def test_white_residuals_are_those_of_a_plain_kalman_filter_of_the_present_readings(
    pattern: str, correlation: float
) -> None:
    """To rounding, if the first reading is missing. Otherwise the gain is steady once it is within 1e-3."""
    residual = residuals(pattern, correlation)
    white = whitening(correlation)(residual).numpy()
    expected = reference(residual.numpy(), correlation)
    assert np.array_equal(np.isnan(white), np.isnan(residual.numpy()))
    error = np.nan_to_num(np.abs(white - expected))
    assert error[1000:].max() < 1e-4
    if pattern == "never":
        assert error.max() < 1e-6


@pytest.mark.parametrize("correlation", CORRELATIONS)
@pytest.mark.parametrize("pattern", PATTERNS)
def test_residuals_beside_missing_readings_are_white_with_unit_variance(pattern: str, correlation: float) -> None:
    white = whitening(correlation)(residuals(pattern, correlation))[300:]
    for channel in white.T:
        values, pairs = channel[channel.isfinite()], (channel[1:] * channel[:-1])
        pairs = pairs[pairs.isfinite()]
        if not len(values):
            continue
        assert float(values.square().mean()) == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / len(values)))
        assert abs(float(pairs.mean())) < 4.0 / math.sqrt(len(pairs))


@pytest.mark.parametrize("correlation", CORRELATIONS)
@pytest.mark.parametrize("pattern", PATTERNS)
def test_any_division_into_calls_gives_the_same_innovations_and_memory_to_the_last_bit(
    pattern: str, correlation: float
) -> None:
    residual, flows = residuals(pattern, correlation)[:1200], flow_filter(correlation)
    whole, path = flows(residual)
    memory, parts, paths = None, [], []
    for first in range(0, len(residual), 7):
        part, after = flows(residual[first : first + 7], first, memory)
        memory = after[-1]
        parts.append(part)
        paths.append(after)
    assert torch.equal(torch.cat(parts).nan_to_num(), whole.nan_to_num())
    assert torch.equal(torch.cat(paths), path)
    again, _ = flows(residual[337:], 337, path[336], states=False)
    assert torch.equal(again.nan_to_num(), whole[337:].nan_to_num())


def test_a_lane_does_not_depend_on_the_missing_readings_of_its_neighbours() -> None:
    flows = flow_filter(0.7)
    lanes = torch.stack([residuals(pattern, 0.7)[:1200] for pattern in PATTERNS])
    together, path = flows(lanes)
    white = whitening(0.7)(lanes)
    for k, lane in enumerate(lanes):
        alone, own = flows(lane)
        assert torch.equal(together[k].nan_to_num(), alone.nan_to_num()) and torch.equal(path[k], own)
        assert torch.equal(white[k].nan_to_num(), whitening(0.7)(lane).nan_to_num())


def test_the_covariance_returns_to_its_steady_value_after_an_outage_and_grows_in_one() -> None:
    flows, residual = flow_filter(0.0), residuals("all", 0.0).clone()
    residual[1000:2000, 0] = torch.nan
    path = flows(residual)[1]
    for before in (0, 500, 3000, COUNT - 1):
        assert torch.equal(flows.covariance_after(path[before]), flows.covariance)
    within = flows.covariance_after(path[1999])
    assert torch.equal(within, within.mT) and float(torch.linalg.eigvalsh(within)[0]) > 0.0
    assert float(within[0, 0]) > 2.0 * float(flows.covariance[0, 0])
    assert float(torch.linalg.eigvalsh(within - flows.covariance)[0]) > -1e-9


@pytest.mark.parametrize(("dead", "by"), [(0, 315.0), (1, 315.0), (2, 340.0)])
def test_a_leak_is_seen_and_isolated_without_a_sensor(dead: int, by: float) -> None:
    run = recorded(step_to("T3.leak.size", 0.05, 300.0), 440, seed=3)
    run.readings[150:, dead] = torch.nan
    state, events = followed(monitor(), run, 500)
    assert [e.kind for e in events[:3]] == ["notice", "alarm", "isolated"]
    assert 300.0 < events[1].time < by
    assert events[2].explanations[0].names == ("T3.leak.size",)
    other, again = followed(monitor(), run, 7)
    assert [(e.time, e.text) for e in again] == [(e.time, e.text) for e in events]
    assert torch.equal(other.white[-100:].nan_to_num(), state.white[-100:].nan_to_num())
    assert torch.equal(other.memory[-100:], state.memory[-100:])


def test_a_dead_sensor_raises_no_false_alarms_beside_random_flows() -> None:
    """Flows of 5 % of the pumps'. With the gain for all readings, a dead h1 raised 70 times the expected number."""

    def disturbed(count: int, seed: int) -> Tensor:
        shocks = torch.randn(count, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        flow, path, keep = torch.zeros(2, dtype=torch.float64), [], math.exp(-1.0 / 20.0)
        for shock in shocks:
            flow = keep * flow + math.sqrt(1.0 - keep**2) * shock
            path.append(flow)
        return 1.0 + 0.05 * torch.stack(path)

    learnt, run = (
        replace(
            recorded(lambda t: SPACE.nominal(), count, seed=seed, inputs=INPUTS * disturbed(count, seed + 1000)),
            inputs=INPUTS.expand(count, 2),
        )
        for count, seed in ((3000, 1), (6000, 7))
    )
    noise = learn_noise(NETWORK, learnt, SPACE, SPACE.nominal())[0]
    draws = torch.Generator().manual_seed(0)
    detector = make_detector("cusum", 2000.0, 1.0, 3, draws, learnt=noise.whitening)
    row = torch.arange(len(run))
    for read in (row < 200, row % 130 < 50):
        readings = run.readings.clone()
        readings[~read, 0] = torch.nan
        seen = Observer(NETWORK, noise.gain, SPACE, SPACE.nominal()).run(replace(run, readings=readings))
        alarms = int(detector.alarms(noise.whitening(seen.steady_residual)).sum())
        assert alarms <= poisson.ppf(0.999, len(run) / 2000.0)
