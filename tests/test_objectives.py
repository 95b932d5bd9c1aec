"""Both objectives against their definitions, and their expansions against finite differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from fdi_torch.estimate.levenberg_marquardt import levenberg_marquardt
from fdi_torch.estimate.objectives import Problem, Term
from fdi_torch.parameters import Parameter, ParameterSpace
from fdi_torch.simulate.engine import Readings, gram_of, moments_of


class Decay:
    """Two channels a exp(-b t) and a t + b: an engine with a closed form."""

    name, why = "closed form", ""

    def __init__(self, samples: int = 40) -> None:
        self.time = torch.linspace(0.0, 3.0, samples, dtype=torch.float64)

    def readings(self, theta: Tensor) -> Tensor:
        a, b = theta.unsqueeze(-2).unbind(-1)
        return torch.stack([a * torch.exp(-b * self.time), a * self.time + b], dim=-1)

    levels = readings

    def linearise(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        a, b = theta.unsqueeze(-2).unbind(-1)
        decay = torch.exp(-b * self.time)
        first = torch.stack([decay, -a * self.time * decay], dim=-1)
        second = torch.stack([self.time.expand_as(decay), torch.ones_like(decay)], dim=-1)
        return self.readings(theta), torch.stack([first, second], dim=-2)

    def moments(self, theta: Tensor, data: Readings) -> Tensor:
        return moments_of(self.readings(theta), data)

    def gram(self, theta: Tensor, data: Readings) -> Tensor:
        return gram_of(*self.linearise(theta), data)


def space(std: float = float("inf")) -> ParameterSpace:
    return ParameterSpace([Parameter("a", "1", 1.0, 0.0, 3.0, std), Parameter("b", "1", 0.5, 0.0, 3.0)])


def problem(
    objective: str, noise: float = 0.02, std: float = float("inf"), known: bool = False, samples: int = 40
) -> Problem:
    engine = Decay(samples)
    generator = torch.Generator().manual_seed(0)
    values = engine.readings(torch.tensor([1.3, 0.8], dtype=torch.float64))
    values = values + noise * torch.randn(values.shape, generator=generator, dtype=torch.float64)
    weight = torch.ones_like(values)
    weight[3:7, 0] = 0.0
    values[3:7, 0] = float("nan")
    level = torch.tensor([0.02, 0.03], dtype=torch.float64) if known else None
    return Problem(space(std), [Term(engine, Readings(values, weight), noise_std=level)], objective)  # type: ignore[arg-type]


THETA = torch.tensor([[[1.1, 0.6], [2.0, 1.5], [1.3, 0.8]]], dtype=torch.float64)
LANE = torch.zeros(1, dtype=torch.int64)


def test_correlation_is_pearsons() -> None:
    p = problem("correlation")
    data = p.terms[0].data
    predicted = p.terms[0].engine.readings(THETA[0])
    for k in range(3):
        for c in range(2):
            keep = (data.weight[:, c] > 0).numpy()
            rho = np.corrcoef(data.values[keep, c].numpy(), predicted[k, keep, c].numpy())[0, 1]
            assert float(p.correlations(THETA, LANE)[0, k, c]) == pytest.approx(rho, abs=1e-13)


def test_correlation_keeps_its_digits_next_to_one() -> None:
    p = problem("correlation", noise=0.0)
    truth = torch.tensor([[[1.3, 0.8]]], dtype=torch.float64)
    nearby = truth + 1e-9
    assert float(p.cost(truth, LANE)) < 1e-25
    assert 1e-20 < float(p.cost(nearby, LANE)) < 1e-16


def test_the_likelihood_of_exact_readings_is_finite_and_greatest_at_the_truth() -> None:
    p = problem("likelihood", noise=0.0)
    truth = torch.tensor([[[1.3, 0.8], [1.3, 0.8 + 1e-7]]], dtype=torch.float64)
    at, beside = p.cost(truth, LANE)[0].tolist()
    assert math.isfinite(at) and at < beside
    assert torch.isfinite(p.linearise(truth[0, :1], LANE).curvature).all()


def test_noise_is_as_large_as_it_was_whatever_the_parameters_took_up() -> None:
    """Five samples of two channels for two parameters: the mean square of residuals alone would be a fifth short."""
    engine, lanes = Decay(5), torch.arange(2000)
    truth = torch.tensor([1.3, 0.8], dtype=torch.float64)
    drawn = torch.randn(2000, 5, 2, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    values = engine.readings(truth) + 1e-3 * drawn
    known = torch.full((2,), 1e-3, dtype=torch.float64)
    p = Problem(space(), [Term(engine, Readings(values, torch.ones_like(values)), noise_std=known)], "likelihood")
    low, high = (torch.full((2,), end, dtype=torch.float64) for end in (0.0, 3.0))
    found = levenberg_marquardt(p.linearise, truth.expand(2000, 2), low, high)
    (noise,) = p.noise(found.theta, lanes)
    assert float(noise.square().mean().sqrt()) == pytest.approx(1e-3, rel=0.02)


def test_parameters_of_several_recordings_take_their_degrees_of_freedom_once() -> None:
    """Two parameters from two recordings of two channels: half a degree of each channel of each recording."""
    one, two = problem("likelihood"), problem("likelihood", noise=0.05, samples=60)
    both = Problem(space(), [*one.terms, *two.terms], "likelihood")
    theta = THETA[0, 2:]
    for term, noise in zip(both.terms, both.noise(theta, LANE), strict=True):
        residual = term.data.known - term.engine.readings(theta)[0]
        squares, count = (term.data.weight * residual**2).sum(0), term.data.weight.sum(0)
        assert torch.allclose(noise[0] ** 2, squares / (count - 0.5), rtol=1e-12)


def test_known_noise_gives_half_chi_square() -> None:
    p = problem("likelihood", known=True)
    data = p.terms[0].data
    residual = data.known - p.terms[0].engine.readings(THETA[0, 0])
    scaled = data.weight * (residual / torch.tensor([0.02, 0.03], dtype=torch.float64)) ** 2
    assert float(p.cost(THETA, LANE)[0, 0]) == pytest.approx(0.5 * float(scaled.sum()), rel=1e-12)


@pytest.mark.parametrize(("objective", "known"), [("correlation", False), ("likelihood", False), ("likelihood", True)])
def test_gradient_is_that_of_the_cost(objective: str, known: bool) -> None:
    p = problem(objective, std=0.3, known=known)
    theta = THETA[0]
    model = p.linearise(theta, LANE.expand(3))
    assert torch.allclose(model.cost, p.cost(theta.unsqueeze(0), LANE)[0], rtol=1e-12)
    for i in range(2):
        push = torch.zeros(2, dtype=torch.float64)
        push[i] = 1e-6
        up, down = (p.cost((theta + s * push).unsqueeze(0), LANE)[0] for s in (1, -1))
        assert torch.allclose(model.gradient[:, i], (up - down) / 2e-6, rtol=2e-6, atol=1e-6)


@pytest.mark.parametrize("objective", ["correlation", "likelihood"])
def test_curvature_is_that_of_the_cost_where_residuals_are_small(objective: str) -> None:
    # Unknown noise levels bend the cost by a share of about 1/samples, which Gauss-Newton leaves out.
    p = problem(objective, noise=1e-5, samples=1000)
    truth = torch.tensor([[1.3, 0.8]], dtype=torch.float64)
    best = levenberg_marquardt(p.linearise, truth, p.space.low(), p.space.high()).theta
    model = p.linearise(best, LANE)
    push = 1e-4 if objective == "correlation" else 1e-7
    for i in range(2):
        step = torch.zeros(2, dtype=torch.float64)
        step[i] = push
        slopes = [p.linearise(best + s * step, LANE).gradient for s in (1, -1)]
        numeric = (slopes[0] - slopes[1])[0] / (2 * push)
        assert torch.allclose(model.curvature[0, i], numeric, rtol=2e-2, atol=1e-3 * float(model.curvature.abs().max()))


def test_several_recordings_add_up() -> None:
    one, two = problem("likelihood"), problem("likelihood", noise=0.05)
    both = Problem(space(), [*one.terms, *two.terms], "likelihood")
    assert torch.allclose(both.cost(THETA, LANE), one.cost(THETA, LANE) + two.cost(THETA, LANE), rtol=1e-14)
    a, b, c = (p.linearise(THETA[0], LANE.expand(3)) for p in (one, two, both))
    assert torch.allclose(c.curvature, a.curvature + b.curvature, rtol=1e-13)


def test_constant_channels_have_no_correlation() -> None:
    engine = Decay()
    values = torch.ones(40, 2, dtype=torch.float64)
    values[:, 0] = engine.time
    with pytest.raises(ValueError, match=r"constant one \(number 2\), whose correlation is undefined"):
        Problem(space(), [Term(engine, Readings(values, torch.ones_like(values)))], "correlation")
