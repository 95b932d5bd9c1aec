"""Profile likelihood and draws against cases whose answer is known in closed form."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from scipy import stats
from torch import Tensor

from fdi_torch.estimate.levenberg_marquardt import levenberg_marquardt
from fdi_torch.estimate.linearisation import Linearisation
from fdi_torch.estimate.posterior_draws import Draws, draw_posterior
from fdi_torch.estimate.profile import Profile, profile_likelihood
from fdi_torch.estimate.ridges import ridge_coordinates
from fdi_torch.estimate.uncertainty import Estimate, make_estimate
from fdi_torch.parameters import Parameter, ParameterSpace

DOUBLE = torch.float64


class LeastSquares:
    """Residuals r(theta) in units of their standard deviation, with the interface of `Problem`."""

    def __init__(self, residuals: Callable[[Tensor], Tensor], space: ParameterSpace) -> None:
        self.residuals, self.space = residuals, space
        self.jacobian = torch.func.vmap(torch.func.jacfwd(residuals))

    def cost(self, theta: Tensor, lanes: Tensor) -> Tensor:
        return 0.5 * (self.residuals(theta) ** 2).sum(-1)

    def linearise(self, theta: Tensor, lanes: Tensor) -> Linearisation:
        r, j = self.residuals(theta), self.jacobian(theta)
        return Linearisation(0.5 * (r * r).sum(-1), (j.mT @ r[..., None])[..., 0], j.mT @ j)

    def fit(self) -> tuple[Estimate, Tensor]:
        start = self.space.nominal()[None]
        best = levenberg_marquardt(self.linearise, start, self.space.low(), self.space.high())
        return make_estimate(self.space, best.theta[0], best.curvature[0]), best.curvature[0]

    def profile(self, name: str, confidence: float = 0.95) -> Profile:
        return profile_likelihood(self.linearise, self.space, self.fit()[0], [name], confidence)[0]

    def draws(self, **settings: Any) -> Draws:
        estimate, information = self.fit()
        coordinates = ridge_coordinates(self.linearise, self.space, estimate.value, information)
        return draw_posterior(self.cost, self.space, estimate.value, information, coordinates=coordinates, **settings)


DESIGN = torch.tensor([[1.0, 0.2], [0.3, 1.5], [0.7, 0.7], [-0.4, 1.1]], dtype=DOUBLE)
TRUTH = torch.tensor([0.4, -0.7], dtype=DOUBLE)
READINGS = DESIGN @ TRUTH + torch.tensor([0.3, -0.5, 0.8, 0.1], dtype=DOUBLE)
QUANTILE = stats.norm.ppf(0.975)


def linear() -> LeastSquares:
    space = ParameterSpace([Parameter("a", "m", 0.5, -50.0, 50.0), Parameter("b", "1", 0.0, -50.0, 50.0)])
    return LeastSquares(lambda theta: theta @ DESIGN.mT - READINGS, space)


def ridge(std: float = 0.05) -> LeastSquares:
    """Only the product c (1 - d) is measured, as for an orifice coefficient and a plugging."""
    space = ParameterSpace([Parameter("c", "1", 0.6, 0.4, 1.0), Parameter("d", "1", 0.1, 0.0, 1.0)])
    return LeastSquares(lambda theta: ((theta[..., 0] * (1.0 - theta[..., 1]) - 0.48) / (0.48 * std))[..., None], space)


@pytest.mark.parametrize("confidence", [0.68, 0.95])
def test_profile_of_a_linear_gaussian_case_is_the_normal_interval(confidence: float) -> None:
    problem = linear()
    estimate, _ = problem.fit()
    for i, name in enumerate(problem.space.names):
        profile = problem.profile(name, confidence)
        low, high = (float(limit[i]) for limit in estimate.interval(confidence))
        assert (profile.low, profile.high) == pytest.approx((low, high), abs=3e-3 * float(estimate.std[i]))
        square = ((profile.x - estimate.value[i]) / estimate.std[i]) ** 2
        # Fits stop at a Newton decrement of 1e-4, half the ratio.
        torch.testing.assert_close(profile.ratio, square, rtol=0.0, atol=2e-4)
        assert not profile.ends and not profile.warnings and bool(profile.converged.all())


def test_profile_at_a_bound_ends_there_and_follows_the_likelihood_inside() -> None:
    """The unconstrained optimum is below the bound: the ratio counts from the bound on."""
    free, _ = linear().fit()
    bound = float(free.value[0] + 1.5 * free.std[0])
    space = ParameterSpace([Parameter("a", "m", bound, bound, 50.0), Parameter("b", "1", 0.0, -50.0, 50.0)])
    bounded = LeastSquares(linear().residuals, space)
    profile = bounded.profile("a")
    # (x - a)^2 / s^2 - 1.5^2 = q^2 at the upper limit.
    high = float(free.value[0] + free.std[0] * math.hypot(1.5, QUANTILE))
    assert profile.low == profile.value == bound and profile.ends == ("low",)
    assert profile.high == pytest.approx(high, abs=3e-3 * float(free.std[0]))


def test_coverage_at_a_bound_is_at_least_what_is_stated() -> None:
    """The true value lies at the bound: the interval contains it in 97.5 % of all cases (Self and Liang 1987)."""
    x = torch.randn(400, dtype=DOUBLE, generator=torch.Generator().manual_seed(3))
    contained = 0
    for reading in x[:120]:
        space = ParameterSpace([Parameter("a", "m", 0.0, 0.0, 50.0)])
        profile = LeastSquares(lambda theta, y=reading: theta - y, space).profile("a")
        contained += profile.low <= 0.0
    assert stats.binomtest(contained, 120, 0.975).pvalue > 0.01 and contained < 120


def test_profile_follows_a_curved_ridge_to_the_bounds() -> None:
    """c (1 - d) = 0.48 within 1.96 * 5 %: d is as great as the largest c allows, and as small as zero."""
    problem = ridge()
    profiles = {name: problem.profile(name) for name in "cd"}
    assert profiles["d"].low == 0.0 and profiles["d"].ends == ("low",)
    assert profiles["d"].high == pytest.approx(1.0 - 0.48 * (1.0 - 0.05 * QUANTILE) / 1.0, abs=1e-3)
    assert profiles["c"].low == pytest.approx(0.48 * (1.0 - 0.05 * QUANTILE), abs=1e-3)
    assert profiles["c"].high == 1.0 and profiles["c"].ends == ("high",)
    on_ridge = profiles["d"].ratio < 1e-3
    assert on_ridge.sum() >= 3
    torch.testing.assert_close(
        (profiles["d"].theta[on_ridge, 0] * (1.0 - profiles["d"].x[on_ridge])),
        torch.full((int(on_ridge.sum()),), 0.48, dtype=DOUBLE),
        atol=2e-3,
        rtol=0.0,
    )


def test_profile_leaves_a_local_minimum_by_its_neighbours_and_says_that_the_estimate_was_not_the_best() -> None:
    """Two wells: the estimate stands in the shallow one."""
    space = ParameterSpace([Parameter("a", "1", 1.0, -3.0, 3.0), Parameter("b", "1", 0.0, -9.0, 9.0)])
    problem = LeastSquares(
        lambda t: torch.stack((2.0 * (t[..., 0] ** 2 - 1.0), t[..., 0] + 1.0, t[..., 1] - t[..., 0]), -1), space
    )
    assert problem.fit()[0].value[0] > 0.8
    profile = problem.profile("a")
    assert profile.value == pytest.approx(-1.0, abs=1e-2) and profile.improvement > 1.0
    assert "not the best fit" in profile.headline


def test_profile_of_an_unbounded_undetermined_parameter_is_refused() -> None:
    space = ParameterSpace([Parameter("a", "1", 1.0), Parameter("b", "1", 1.0)])
    with pytest.raises(ValueError, match="a: expected a finite standard error or a range"):
        LeastSquares(lambda t: t.sum(-1, keepdim=True), space).profile("a")
    with pytest.raises(ValueError, match=r"expected a parameter \(a, b\), got 'c'"):
        LeastSquares(lambda t: t, space).profile("c")
    with pytest.raises(ValueError, match="expected a confidence between 0 and 1, got 95"):
        LeastSquares(lambda t: t, space).profile("a", 95)


@pytest.fixture(scope="module")
def linear_draws() -> Draws:
    pytest.importorskip("emcee")
    return linear().draws(draws=4000, seed=5)


def test_draws_of_a_linear_gaussian_case_have_its_mean_and_covariance(linear_draws: Draws) -> None:
    estimate, _ = linear().fit()
    flat = linear_draws.values.flatten(0, 1)
    error = estimate.std / linear_draws.ess_bulk.sqrt()
    assert linear_draws.converged and not linear_draws.warnings
    assert bool(((flat.mean(0) - estimate.value).abs() < 4.0 * error).all())
    torch.testing.assert_close(flat.T.cov(), estimate.covariance, rtol=0.15, atol=0.15 * float(estimate.std.min()) ** 2)


def test_draws_repeat_for_a_seed(linear_draws: Draws) -> None:
    assert torch.equal(linear().draws(draws=4000, seed=5).values, linear_draws.values)
    assert not torch.equal(linear().draws(draws=4000, seed=6).values, linear_draws.values)


def test_draws_at_a_bound_are_the_truncated_normal_distribution() -> None:
    pytest.importorskip("emcee")
    space = ParameterSpace([Parameter("a", "m", 0.5, 0.0, 50.0)])
    draws = LeastSquares(lambda theta: theta + 1.0, space).draws(draws=4000)
    truth = stats.truncnorm(1.0, 51.0, loc=-1.0)
    assert draws.converged and float(draws.values.min()) >= 0.0
    high = draws.interval()[1]
    assert float(high) == pytest.approx(truth.ppf(0.975), rel=0.15)
    assert float(draws.values.mean()) == pytest.approx(
        truth.mean(), abs=4.0 * truth.std() / math.sqrt(float(draws.ess_bulk))
    )


def test_draws_fill_the_ridge_where_the_standard_error_is_undetermined() -> None:
    """The marginal of c by quadrature: its likelihood integrated over d in [0, 1]."""
    pytest.importorskip("emcee")
    problem = ridge()
    assert not bool(torch.isfinite(problem.fit()[0].std).any())
    draws = problem.draws(draws=4000)
    c, d = torch.linspace(0.4, 1.0, 1201, dtype=DOUBLE), torch.linspace(0.0, 1.0, 2001, dtype=DOUBLE)
    grid = torch.stack(torch.meshgrid(c, d, indexing="ij"), -1)
    density = torch.exp(-problem.cost(grid, torch.zeros(1))).sum(1)
    distribution = (density / density.sum()).cumsum(0)
    assert draws.converged
    for share in (0.1, 0.5, 0.9):
        quantile = float(c[int((distribution >= share).nonzero()[0])])
        # Standard error of a share from the effective number of draws.
        below = float((draws.values[..., 0] <= quantile).double().mean())
        assert below == pytest.approx(share, abs=4.0 * math.sqrt(share * (1 - share) / float(draws.ess_bulk[0])))


def test_draws_follow_a_curved_ridge_that_is_hundreds_of_times_as_long_as_wide() -> None:
    """c is known within 3 %, c (1 - d) within 0.01 %: the marginal density of c is its prior divided by c."""
    pytest.importorskip("emcee")
    space = ParameterSpace([Parameter("c", "1", 0.6, 0.06, 6.0), Parameter("d", "1", 0.1, -1.0, 1.0)])
    problem = LeastSquares(
        lambda t: torch.stack((1e4 * (t[..., 0] * (1.0 - t[..., 1]) / 0.48 - 1.0), (t[..., 0] - 0.6) / 0.018), -1),
        space,
    )
    draws = problem.draws(draws=4000)
    assert draws.converged and draws.steps <= 4000
    c = torch.linspace(0.5, 0.7, 20_001, dtype=DOUBLE)
    density = torch.exp(-0.5 * ((c - 0.6) / 0.018) ** 2) / c
    distribution = (density / density.sum()).cumsum(0)
    for share in (0.025, 0.5, 0.975):
        below = float((draws.values[..., 0] <= float(c[int((distribution >= share).nonzero()[0])])).double().mean())
        assert below == pytest.approx(share, abs=4.0 * math.sqrt(share * (1 - share) / float(draws.ess_bulk[0])))
    product = draws.values[..., 0] * (1.0 - draws.values[..., 1])
    assert float(product.std()) == pytest.approx(0.48e-4, rel=0.1)


def test_ridge_coordinates_are_undone_exactly_and_have_the_information_of_their_gradient() -> None:
    problem = ridge(1e-4)
    estimate, information = problem.fit()
    straight = ridge_coordinates(problem.linearise, problem.space, estimate.value, information)
    assert len(straight.along) == 1
    theta = torch.tensor([[0.5, 0.1], [0.7, 0.3], [0.39, 1.2]], dtype=DOUBLE)
    torch.testing.assert_close(straight.theta(straight.phi(theta)), theta, rtol=0.0, atol=1e-12)
    phi = straight.phi(estimate.value)
    columns = [(straight.theta(phi + e) - straight.theta(phi - e)) / 2e-6 for e in 1e-6 * torch.eye(2, dtype=DOUBLE)]
    jacobian = torch.stack(columns, -1)
    assert float(torch.linalg.det(jacobian)) == pytest.approx(1.0, abs=1e-6)
    expected = jacobian.mT @ information @ jacobian
    difference = (straight.information(estimate.value, information) - expected).abs().max()
    assert float(difference) < 1e-5 * float(information.abs().max())


def test_draws_tell_the_share_of_the_steps_allowed_and_end_at_one() -> None:
    pytest.importorskip("emcee")
    told: list[tuple[float, str]] = []
    linear().draws(draws=100, most_steps=1000, tell=lambda share, text: told.append((share, text)))
    assert [share for share, _ in told[:3]] == pytest.approx([0.1, 0.2, 0.3]) and told[-1][0] == 1.0
    assert all(f"{round(1000 * share)} steps" in text for share, text in told[:-1])


def test_draws_that_have_not_converged_say_so() -> None:
    pytest.importorskip("emcee")
    draws = linear().draws(draws=100, most_steps=20)
    assert not draws.converged and "have not converged after 20 steps: R-hat" in draws.headline
