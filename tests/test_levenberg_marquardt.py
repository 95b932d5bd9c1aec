"""Levenberg-Marquardt against SciPy and closed forms; members of a batch never feel one another."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares, lsq_linear
from torch import Tensor

from fdi_torch.estimate.batch_algebra import apply, row_sum, solve_positive
from fdi_torch.estimate.damped_step import Quadratic, damped_step, newton_decrement
from fdi_torch.estimate.levenberg_marquardt import Competition, Progress, RefineSettings, levenberg_marquardt
from fdi_torch.estimate.linearisation import Linearisation, Refined, held_back

DOUBLE = torch.float64
INF = math.inf
TIME = torch.linspace(0.0, 4.0, 41, dtype=DOUBLE)


def rows(*values: list[float]) -> Tensor:
    return torch.tensor(values, dtype=DOUBLE)


@dataclass
class LeastSquares:
    """cost = |r|^2 / 2 with explicit sums; residual(theta (L, P), lanes (L,)) -> r (L, S), J (L, S, P)."""

    residual: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
    calls: int = 0

    def linearise(self, theta: Tensor, lanes: Tensor) -> Linearisation:
        self.calls += 1
        r, jacobian = self.residual(theta, lanes)
        columns = jacobian.mT
        curvature = row_sum(columns[:, :, None, :] * columns[:, None, :, :])
        return Linearisation(0.5 * row_sum(r * r), apply(columns, r), curvature)


def rosenbrock(theta: Tensor, lanes: Tensor) -> tuple[Tensor, Tensor]:
    x, y = theta.unbind(-1)
    zero = torch.zeros_like(x)
    jacobian = torch.stack((torch.stack((-20.0 * x, zero + 10.0), -1), torch.stack((zero - 1.0, zero), -1)), -2)
    return torch.stack((10.0 * (y - x * x), 1.0 - x), -1), jacobian


def decays(theta: Tensor) -> tuple[Tensor, Tensor]:
    """a exp(-b t) + c exp(-d t) and its Jacobian."""
    a, b, c, d = theta[..., None].unbind(-2)
    first, second = torch.exp(-b * TIME), torch.exp(-d * TIME)
    jacobian = torch.stack((first, -a * TIME * first, second, -c * TIME * second), -1)
    return a * first + c * second, jacobian


TRUTH = rows([2.0, 0.4, 1.0, 3.0])[0]
DATA = decays(TRUTH)[0] + 0.02 * torch.randn(12, 41, dtype=DOUBLE, generator=torch.Generator().manual_seed(3))
DECAYS = LeastSquares(lambda theta, lanes: (decays(theta)[0] - DATA[lanes], decays(theta)[1]))
START = rows([1.0, 0.2, 0.5, 2.0]).expand(12, 4)
FREE = (torch.full((4,), -INF, dtype=DOUBLE), torch.full((4,), INF, dtype=DOUBLE))
BOXED = (rows([0.0, 0.0, 0.0, 0.0])[0], rows([1.8, 10.0, 10.0, 2.5])[0])
TIGHT = RefineSettings(decrease_tolerance=1e-18)


def by_scipy(lane: int, low: Tensor, high: Tensor) -> np.ndarray:
    def residual(theta: np.ndarray) -> np.ndarray:
        return (decays(torch.from_numpy(theta))[0] - DATA[lane]).numpy()

    return least_squares(
        residual, START[lane].numpy(), bounds=(low.numpy(), high.numpy()), xtol=1e-15, ftol=1e-15, gtol=1e-15
    ).x


def test_rosenbrock_from_the_classical_start() -> None:
    start = rows([-1.2, 1.0], [5.0, -5.0])
    problem = LeastSquares(rosenbrock)
    result = levenberg_marquardt(problem.linearise, start, -FREE[1][:2], FREE[1][:2], TIGHT)
    torch.testing.assert_close(result.theta, torch.ones(2, 2, dtype=DOUBLE), rtol=0, atol=1e-8)
    assert result.statuses() == ["converged", "converged"]
    assert problem.calls <= 60


def test_steps_that_are_short_for_their_damping_are_no_end() -> None:
    problem = LeastSquares(rosenbrock)
    result = levenberg_marquardt(
        problem.linearise, rows([-1.2, 1.0]), -FREE[1][:2], FREE[1][:2], replace(TIGHT, damping=1e12)
    )
    torch.testing.assert_close(result.theta, torch.ones(1, 2, dtype=DOUBLE), rtol=0, atol=1e-8)


@pytest.mark.parametrize("bounds", [FREE, BOXED], ids=["free", "boxed"])
def test_exponentials_end_where_scipy_ends(bounds: tuple[Tensor, Tensor]) -> None:
    low, high = bounds
    result = levenberg_marquardt(DECAYS.linearise, START, low, high, TIGHT)
    assert set(result.statuses()) == {"converged"}
    for lane in range(12):
        np.testing.assert_allclose(result.theta[lane].numpy(), by_scipy(lane, low, high), rtol=2e-6)
    assert bool(result.held.any()) is (bounds is BOXED)


def test_solution_at_a_bound_satisfies_karush_kuhn_tucker() -> None:
    low, high = BOXED
    result = levenberg_marquardt(DECAYS.linearise, START, low, high, TIGHT)
    at_low, at_high = result.theta == low, result.theta == high
    assert (at_low | at_high).any(-1).all()
    assert torch.equal(result.held, at_low | at_high)
    scale = result.curvature.diagonal(dim1=-2, dim2=-1).sqrt()
    free = torch.where(result.held, 0.0, result.gradient / scale)
    assert free.abs().max() < 1e-7
    assert (result.gradient[at_high] < 0).all() and (result.gradient[at_low] > 0).all()


def test_bounds_may_differ_from_member_to_member_and_hold_a_parameter_fast() -> None:
    low, high = FREE[0].expand(12, 4).clone(), FREE[1].expand(12, 4).clone()
    low[3, 1] = high[3, 1] = 0.5
    result = levenberg_marquardt(DECAYS.linearise, START, low, high, TIGHT)
    free = levenberg_marquardt(DECAYS.linearise, START, *FREE, TIGHT)
    assert result.theta[3, 1] == 0.5 and result.held[3].tolist() == [False, True, False, False]
    others = torch.arange(12) != 3
    assert torch.equal(result.theta[others], free.theta[others])


def test_linear_problem_of_mixed_units_with_many_active_bounds() -> None:
    """A quadratic in 12 dimensions whose unbounded optimum lies outside of the box in many of them."""
    generator = torch.Generator().manual_seed(0)
    design = torch.randn(60, 12, dtype=DOUBLE, generator=generator)
    data = 2.0 * torch.randn(5, 60, dtype=DOUBLE, generator=generator)
    scale = 10.0 ** torch.arange(-6, 6, dtype=DOUBLE)

    def residual(theta: Tensor, lanes: Tensor) -> tuple[Tensor, Tensor]:
        return apply(design, theta * scale) - data[lanes], (design * scale).expand(len(lanes), -1, -1)

    problem = LeastSquares(residual)
    start, half = torch.zeros(5, 12, dtype=DOUBLE), 0.1 / scale
    result = levenberg_marquardt(problem.linearise, start, -half, half, TIGHT)
    assert set(result.statuses()) == {"converged"} and result.held.any(-1).all()
    for lane in range(5):
        box = (-0.1 * np.ones(12), 0.1 * np.ones(12))
        exact = lsq_linear(design.numpy(), data[lane].numpy(), bounds=box, tol=1e-15)
        np.testing.assert_allclose((result.theta[lane] * scale).numpy(), exact.x, atol=1e-7)
    free = levenberg_marquardt(problem.linearise, start, -torch.full_like(half, INF), torch.full_like(half, INF), TIGHT)
    solution = torch.linalg.lstsq(design, data.mT).solution.mT
    torch.testing.assert_close(free.theta * scale, solution, rtol=1e-9, atol=1e-9)


def with_trouble(theta: Tensor, lanes: Tensor) -> tuple[Tensor, Tensor]:
    """Member 4 is NaN from the start; member 7 cannot be evaluated where b > 0.38, on the way to its optimum."""
    model, jacobian = decays(theta)
    bad = (lanes == 4) | ((lanes == 7) & (theta[:, 1] > 0.38))
    return torch.where(bad[:, None], math.nan, model - DATA[lanes]), jacobian


def test_member_is_bit_equal_alone_and_beside_members_in_trouble() -> None:
    def method(residual: Callable, start: Tensor) -> Refined:
        return levenberg_marquardt(LeastSquares(residual).linearise, start, *BOXED)

    together = method(with_trouble, START)
    assert together.statuses()[4] == "failed"
    assert torch.equal(together.theta[4], START[4]) and "failed" not in np.delete(together.statuses(), 4)
    assert torch.isfinite(together.cost[7]) and together.theta[7, 1] <= 0.38
    for lane in (0, 4, 5, 7, 11):
        alone = method(lambda theta, _, b=lane: with_trouble(theta, torch.full((1,), b)), START[lane])
        for field, value in vars(alone).items():
            if value is not None:
                inside = getattr(together, field)[lane]
                assert torch.equal(value.nan_to_num(-7.0), inside.nan_to_num(-7.0)), (lane, field)


def test_unidentifiable_direction_survives() -> None:
    """Only the product a c of a exp(-b t) c is determined, and d does nothing at all."""

    def residual(theta: Tensor, lanes: Tensor) -> tuple[Tensor, Tensor]:
        a, b, c, _ = theta[..., None].unbind(-2)
        shape = torch.exp(-b * TIME)
        jacobian = torch.stack((c * shape, -a * c * TIME * shape, a * shape, torch.zeros_like(shape)), -1)
        return a * c * shape - 6.0 * torch.exp(-0.7 * TIME), jacobian

    result = levenberg_marquardt(LeastSquares(residual).linearise, START[:2], *FREE, TIGHT)
    assert result.statuses() == ["converged"] * 2
    torch.testing.assert_close(result.theta[:, 0] * result.theta[:, 2], torch.full((2,), 6.0, dtype=DOUBLE))
    torch.testing.assert_close(result.theta[:, 1], torch.full((2,), 0.7, dtype=DOUBLE))
    assert torch.equal(result.theta[:, 3], START[:2, 3])


def test_units_of_the_parameters_change_only_the_rounding() -> None:
    unit = rows([1e-6, 1e3, 1e4, 1e-3])[0]

    def residual(theta: Tensor, lanes: Tensor) -> tuple[Tensor, Tensor]:
        model, jacobian = decays(theta / unit)
        return model - DATA[lanes], jacobian / unit

    scaled = levenberg_marquardt(LeastSquares(residual).linearise, START * unit, *FREE, TIGHT)
    plain = levenberg_marquardt(DECAYS.linearise, START, *FREE, TIGHT)
    torch.testing.assert_close(scaled.theta / unit, plain.theta, rtol=1e-8, atol=0)


@dataclass(frozen=True)
class Point:
    """What the valley keeps of a point: its residuals and their Jacobian."""

    residual: Tensor
    jacobian: Tensor

    def lanes(self, which: Tensor) -> "Point":
        return Point(self.residual[which], self.jacobian[which])

    def replaced(self, which: Tensor, new: "Point") -> "Point":
        return Point(self.residual.index_copy(0, which, new.residual), self.jacobian.index_copy(0, which, new.jacobian))


class Valley:
    """c (1 - b) read 3000 times to 0.1 %, c believed to 3 %: a curved floor, 1600 times as long as it is wide."""

    low, high = rows([0.0, -1.0])[0], rows([10.0, 0.99])[0]
    start = rows([1.0, 0.0], [1.0, -0.5], [0.8, 0.3])

    def __init__(self) -> None:
        self.calls = 0

    def linearise(self, theta: Tensor, lanes: Tensor) -> Linearisation:
        self.calls += 1
        c, b = theta.unbind(-1)
        zero = torch.zeros_like(c)
        weight = 3000.0**0.5 / 1e-3
        residual = torch.stack((weight * (c * (1.0 - b) - 0.6), (c - 1.0) / 0.03), -1)
        seen = torch.stack((weight * (1.0 - b), -weight * c), -1)
        jacobian = torch.stack((seen, torch.stack((zero + 1.0 / 0.03, zero), -1)), -2)
        columns = jacobian.mT
        curvature = row_sum(columns[:, :, None, :] * columns[:, None, :, :])
        cost = 0.5 * row_sum(residual * residual)
        return Linearisation(cost, apply(columns, residual), curvature, Point(residual, jacobian))

    def attempt(
        self, theta: Tensor, known: Linearisation, step: Tensor, near: Linearisation | None = None
    ) -> Linearisation:
        return self.linearise(theta, torch.arange(len(theta)))

    def nonlinearity(self, known: Linearisation, trial: Linearisation, step: Tensor) -> Tensor:
        here, there = known.state, trial.state
        assert isinstance(here, Point) and isinstance(there, Point)
        return apply(here.jacobian.mT, there.residual - here.residual - apply(here.jacobian, step))

    def model(self, theta: Tensor, trial: Linearisation) -> Linearisation:
        return trial


def test_a_curved_valley_is_followed_to_its_lowest_point() -> None:
    settings, straight, bent = RefineSettings(100, 5e-3), Valley(), Valley()
    box = Valley.start, Valley.low, Valley.high
    plain = levenberg_marquardt(straight.linearise, *box, settings)
    found = levenberg_marquardt(bent.linearise, *box, settings, neighbourhood=bent)
    assert found.converged.all() and (found.cost < 5e-3).all()
    assert bent.calls < straight.calls and not plain.converged.any()
    for lane in range(3):
        alone = Valley()
        start = Valley.start[lane : lane + 1]
        only = levenberg_marquardt(alone.linearise, start, Valley.low, Valley.high, settings, neighbourhood=alone)
        assert torch.equal(only.theta[0], found.theta[lane]) and torch.equal(only.cost[0], found.cost[lane])


def test_a_lane_far_behind_is_given_up_and_has_not_converged() -> None:
    beaten = RefineSettings(competition=Competition(behind=1e-9, share=10.0, target=0.0))
    result = levenberg_marquardt(DECAYS.linearise, START, *FREE, beaten)
    assert set(result.statuses()) == {"abandoned"} and not result.converged.any()
    assert (result.iterations < levenberg_marquardt(DECAYS.linearise, START, *FREE).iterations).all()


def test_a_lane_that_catches_up_is_not_given_up() -> None:
    """Half the distance in each step leaves a quarter of a parabola: three quarters of the excess are gained."""

    def half_way(theta: Tensor, lanes: Tensor) -> Linearisation:
        x = theta[:, 0]
        return Linearisation(0.5 * x**2, x[:, None], torch.full_like(x, 2.0)[:, None, None])

    start = torch.tensor([[100.0]], dtype=DOUBLE)
    settings = RefineSettings(competition=Competition(behind=1.0, share=0.25, target=0.0))
    found = levenberg_marquardt(half_way, start, -2.0 * start, 2.0 * start, settings)
    assert found.converged.all() and found.cost.item() < 1e-9


def test_a_lane_whose_quadratic_model_reaches_the_reference_is_not_given_up() -> None:
    """Strong damping makes the first step short. The model predicts 455 of the decrease of 400 that is missing."""

    def valley(theta: Tensor, lanes: Tensor) -> Linearisation:
        x = theta[:, 0]
        return Linearisation(0.5 * x**2, x[:, None], (1.0 + 0.1 * x.abs())[:, None, None])

    start = torch.tensor([[100.0]], dtype=DOUBLE)
    settings = RefineSettings(damping=3000.0, competition=Competition(behind=1.0, share=0.25, target=3000.0))
    reaches = replace(settings, competition=Competition(behind=1.0, share=0.25, target=4600.0))
    kept = levenberg_marquardt(valley, start, -2.0 * start, 2.0 * start, reaches)
    assert kept.statuses() == ["converged"]
    given_up = levenberg_marquardt(valley, start, -2.0 * start, 2.0 * start, settings)
    assert given_up.statuses() == ["abandoned"]


def test_each_refusal_doubles_the_growth_of_the_damping() -> None:
    """Nielsen (1999): mu grows by nu = 2, 4, 8 ... with every step in succession that does not lower the cost."""

    def only_up(theta: Tensor, lanes: Tensor) -> Linearisation:
        x = theta[:, 0]
        return Linearisation(x.abs(), torch.ones_like(x)[:, None], torch.ones_like(x)[:, None, None])

    seen: list[Progress] = []
    start = torch.zeros(1, 1, dtype=DOUBLE)
    settings = RefineSettings(iterations=4)
    levenberg_marquardt(only_up, start, start - 9.0, start + 9.0, settings, on_iteration=seen.append)
    assert [p.damping.item() / settings.damping for p in seen] == pytest.approx([2.0, 8.0, 64.0, 1024.0])


def test_a_parameter_is_held_where_its_descent_leads_out_of_the_box() -> None:
    theta, gradient = rows([0.0, 0.0, 1.0, 1.0, 0.5]), rows([3.0, -3.0, 3.0, -3.0, 3.0])
    held = held_back(theta, gradient, torch.zeros_like(theta), torch.ones_like(theta))
    assert held.tolist() == [[True, False, False, True, False]]


def test_predicted_decreases_are_those_of_the_parabola() -> None:
    """3 x^2 / 2 at 2 is 6 above its minimum; a damped step falls short of it, a bound cuts it off."""
    theta, infinite = rows([2.0], [2.0]), rows([INF], [INF])
    model = Quadratic(theta, 3.0 * theta, torch.full((2, 1, 1), 3.0, dtype=DOUBLE), rows([-INF], [1.5]), infinite)
    step = damped_step(model, torch.tensor([1.0, 0.1], dtype=DOUBLE))
    assert step.trial.tolist() == [[pytest.approx(1.0)], [1.5]]
    assert step.predicted.tolist() == pytest.approx([1.5 * (4.0 - 1.0**2), 1.5 * (4.0 - 1.5**2)])
    assert newton_decrement(model)[0].tolist() == pytest.approx([6.0, 6.0])


def test_a_start_outside_the_box_begins_at_its_nearest_point() -> None:
    seen: list[Tensor] = []

    def bowl(theta: Tensor, lanes: Tensor) -> Linearisation:
        seen.append(theta)
        one = torch.ones_like(theta)
        return Linearisation(0.5 * row_sum(theta**2), theta, torch.diag_embed(one))

    levenberg_marquardt(bowl, rows([7.0, -7.0, 0.5]), rows([-1.0] * 3), rows([1.0, 2.0, 3.0]))
    assert seen[0].tolist() == [[1.0, -1.0, 0.5]]


def test_refused_steps_do_not_give_a_lane_up() -> None:
    """Newton's first steps overshoot 1 - exp(-(x - 10)^2 / 2) and are refused; the lane must not be judged by them."""

    def well(theta: Tensor, lanes: Tensor) -> Linearisation:
        x = theta[:, 0] - 10.0
        narrow = torch.exp(-0.5 * x**2)
        curvature = torch.full_like(narrow, 1e-3)
        return Linearisation(10.0 * (1.0 - narrow), (10.0 * narrow * x)[:, None], curvature[:, None, None])

    settings = RefineSettings(competition=Competition(behind=1.0, share=0.25, target=0.0))
    start = torch.tensor([[8.5]], dtype=DOUBLE)
    found = levenberg_marquardt(well, start, torch.full_like(start, -100.0), torch.full_like(start, 100.0), settings)
    assert found.statuses() != ["abandoned"] and found.cost.item() < 1e-6


def test_status_says_out_of_iterations_or_stalled() -> None:
    few = levenberg_marquardt(DECAYS.linearise, START, *FREE, RefineSettings(iterations=2))
    assert set(few.statuses()) == {"max_iterations"} and set(few.iterations.tolist()) == {2}
    assert (few.newton_decrement > 1e-6).all()

    def wrong_way(theta: Tensor, lanes: Tensor) -> Linearisation:
        model = DECAYS.linearise(theta, lanes)
        return replace(model, gradient=-model.gradient)

    stalled = levenberg_marquardt(wrong_way, START, *FREE)
    assert set(stalled.statuses()) == {"stalled"} and torch.equal(stalled.theta, START)


def test_every_iteration_is_shown_and_costs_only_fall() -> None:
    seen: list[Progress] = []
    levenberg_marquardt(DECAYS.linearise, START, *BOXED, on_iteration=seen.append)
    assert [p.iteration for p in seen] == list(range(1, len(seen) + 1))
    cost = torch.full((12,), INF, dtype=DOUBLE)
    for p in seen:
        assert (p.cost <= cost[p.lanes]).all() and ((p.cost < cost[p.lanes]) >= p.accepted).all()
        cost[p.lanes] = p.cost
    assert len(seen[-1].lanes) < 12


@pytest.mark.parametrize("parameters", [1, 2, 5, 30])
def test_solver_solves_and_keeps_its_bits_in_any_batch(parameters: int) -> None:
    generator = torch.Generator().manual_seed(parameters)
    factor = torch.randn(50, parameters, parameters, dtype=DOUBLE, generator=generator)
    matrix = factor @ factor.mT + 0.1 * torch.eye(parameters, dtype=DOUBLE)
    right = torch.randn(50, parameters, dtype=DOUBLE, generator=generator)
    solution, positive = solve_positive(matrix, right)
    assert positive.all()
    torch.testing.assert_close(solution, torch.linalg.solve(matrix, right), rtol=1e-8, atol=1e-10)
    assert all(torch.equal(solve_positive(matrix[i], right[i])[0], solution[i]) for i in range(50))
    assert not solve_positive(-matrix, right)[1].any()
    assert not solve_positive(matrix * math.nan, right)[1].any()


def test_row_sum_keeps_its_bits_in_any_batch() -> None:
    values = torch.rand(300, 37, dtype=DOUBLE, generator=torch.Generator().manual_seed(1))
    total = row_sum(values)
    torch.testing.assert_close(total, values.sum(-1))
    assert all(torch.equal(row_sum(values[i : i + 1]), total[i : i + 1]) for i in range(0, 300, 7))
    assert torch.equal(row_sum(values[:, :0]), torch.zeros(300, dtype=DOUBLE))


def test_misuse_is_refused_in_words() -> None:
    with pytest.raises(ValueError, match=r"expected cost \(L,\), gradient \(L, P\) and curvature"):
        levenberg_marquardt(lambda x, _: Linearisation(x, x, x), START, *FREE)
    with pytest.raises(ValueError, match="expected low <= high"):
        levenberg_marquardt(DECAYS.linearise, START, FREE[1], FREE[0])
    with pytest.raises(ValueError, match="expected iterations >= 0, damping > 0"):
        RefineSettings(damping=0.0)
