"""The posterior over explanations: what a set of several faults has to earn, what a fit is worth whose laws are not
quite the plant's, and which explanations are told together.
"""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from fdi_torch.estimate.evidence import ODDS, log_volume
from fdi_torch.estimate.uncertainty import end_reached
from fdi_torch.monitor.events import size_of
from fdi_torch.monitor.hypothesis import NO_CHANGE, Hypothesis, HypothesisFit, credible_set, merged, with_posterior
from fdi_torch.monitor.hypothesis_fit import Prior
from fdi_torch.parameters import Parameter

READINGS = 600
LIMIT = READINGS + 4.0 * (2.0 * READINGS) ** 0.5


def found(
    columns: tuple[int, ...], evidence: float, misfit: float = 300.0, late: bool = False, mass: float = 1.0
) -> HypothesisFit:
    value = torch.tensor([0.3, 0.2, 0.1], dtype=torch.float64)
    std = torch.full_like(value, 0.02)
    return HypothesisFit(
        Hypothesis(columns, late), value, std, 100.0, 1.5, evidence, misfit, READINGS, LIMIT, probability=mass
    )


def test_the_prior_penalises_each_fault_and_twice_at_one_location() -> None:
    prior = Prior(("T1.leak.size", "T3.leak.size", "T1.plugging.size"), 6)
    one, two = prior(Hypothesis((0,))), prior(Hypothesis((0, 1)))
    assert one == pytest.approx(math.log(ODDS.effect / 6))
    assert two == pytest.approx(2.0 * math.log(ODDS.effect / 6) + math.log(2.0))
    assert prior(Hypothesis((0, 2))) == pytest.approx(two + math.log(ODDS.same_place))
    assert prior(Hypothesis((0, 1), recovered=(0, 1))) == pytest.approx(one), "what goes away together does so once"
    assert prior(NO_CHANGE) == 0.0


def test_the_volume_is_that_of_a_normal_posterior_in_a_uniform_prior() -> None:
    """A parameter known to 0.01 of a range of 2: sqrt(2 pi) 0.01 / 2."""
    curvature = torch.tensor([[1e4]], dtype=torch.float64)
    width = torch.tensor([2.0], dtype=torch.float64)
    assert log_volume(curvature, width) == pytest.approx(math.log(math.sqrt(2.0 * math.pi) * 0.01 / 2.0))
    assert log_volume(1e-9 * curvature, width) == 0.0, "what the data do not show costs nothing"


def test_an_excess_misfit_widens_standard_errors_and_reduces_evidence() -> None:
    """Four times the sum of squares of noise: standard errors double, evidence is a quarter."""
    base = 4000.0
    near, far = found((0,), base - 1200.0, 1200.0), found((1,), base - 1300.0, 1300.0)
    first, second = with_posterior([far, near])
    assert (first.hypothesis.columns, second.hypothesis.columns) == ((0,), (1,))
    assert first.std.tolist() == pytest.approx([0.04] * 3) and first.onset_std == pytest.approx(3.0)
    assert math.log(first.probability / second.probability) == pytest.approx(100.0 / 4.0)
    fitting = replace(near, misfit=300.0)
    assert with_posterior([far, fitting])[0].std.tolist() == [0.02] * 3, "where one fits, nothing is doubted"


def test_probabilities_sum_to_one_and_manners_of_one_change_are_merged() -> None:
    all_of_them = with_posterior([found((0,), 10.0), found((0,), 10.0, late=True), found((1,), 10.5), found((2,), 5.0)])
    assert sum(f.probability for f in all_of_them) == pytest.approx(1.0)
    told = merged(all_of_them)
    assert [f.hypothesis.columns for f in told] == [(0,), (1,), (2,)], "0.5 nats are less than two ways"
    assert sum(f.probability for f in told) == pytest.approx(1.0)


def test_the_credible_set_has_95_percent_and_every_indistinguishable_fit() -> None:
    rival, small = found((1,), 0.0, 301.0, mass=0.3), found((2,), 0.0, 305.0, mass=0.04)
    told = credible_set([found((0,), 0.0, mass=0.66), rival, small])
    assert [f.hypothesis.columns for f in told] == [(0,), (1,)]
    twin = found((2,), 0.0, mass=0.01)
    assert len(credible_set([found((0,), 0.0, mass=0.96), rival, twin])) == 2, "no reading tells the twin apart"


@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_the_volume_at_an_end_of_a_range_is_that_of_a_truncated_posterior(correlation: float) -> None:
    """Against sums over a grid: one parameter that the end holds back, one inside its range; widths 2 and 5."""
    curvature = torch.tensor([[400.0, 40.0 * correlation], [40.0 * correlation, 4.0]], dtype=torch.float64)
    width = torch.tensor([2.0, 5.0], dtype=torch.float64)
    for slope in (4.0, 60.0):
        x = torch.linspace(0.0, 2.0, 4001, dtype=torch.float64)
        y = torch.linspace(-10.0, 10.0, 2001, dtype=torch.float64)
        point = torch.stack(torch.meshgrid(x, y, indexing="ij"), dim=-1)
        cost = slope * point[..., 0] + 0.5 * torch.einsum("...i,ij,...j", point, curvature, point)
        volume = torch.trapezoid(torch.trapezoid(torch.exp(-cost), y), x) / 10.0
        held = torch.tensor([slope, 0.0], dtype=torch.float64)
        assert log_volume(curvature, width, held) == pytest.approx(float(volume.log()), abs=1e-3)
    assert log_volume(1e-12 * curvature, width, 1e-9 * width) == 0.0, "what the data do not show costs nothing"


def test_an_end_of_a_range_is_reached_except_the_nominal_value_and_a_physical_limit() -> None:
    gain = Parameter("Q1.pump_gain.factor", "1", 1.0, 0.0, 2.0, extremes=(0.0,))
    assert [end_reached(gain, value) for value in (0.0, 1.0, 1.99, 1.9995, 2.4)] == [None, None, None, 2.0, 2.0]
    bias = Parameter("h1.sensor_bias.bias", "m", 0.0, -0.1, 0.1)
    assert end_reached(bias, -0.1) == -0.1 and size_of(bias, -0.12, 0.01).std == math.inf
    assert size_of(bias, -0.12, 0.01).shown == "at most -10 cm, the end of its range"
    assert end_reached(replace(gain, low=1.0, extremes=(), high=math.inf), 1.0) is None
