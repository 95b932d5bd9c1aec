"""CMA-ES: evolution strategy with covariance matrix adaptation (Hansen 2016, arXiv 1604.00772, figure 6).

A generation samples x = m + s A z, z normal, A A' = C, in units of the box, and moves mean m, step size s and
covariance C towards the better half. The evolution path of s is the weighted mean of z itself, as for the Cholesky
factor A of Krause, Arbones and Igel (2016, section 3). A candidate outside the box is reflected into it and judged
there, while the update uses x, so that bounds do not shrink the covariance. The search starts in the middle of the box,
or at the first guess, with a step size of 0.3 box widths. It suits costs with one broad basin; L-SHADE, with its larger
population, is the safer choice for several.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.estimate.batch_algebra import apply, dot, row_sum
from fdi_torch.estimate.draws import stream, uniform
from fdi_torch.estimate.evolution_settings import EvolutionSettings
from fdi_torch.estimate.strategy import (
    Proposal,
    SearchState,
    Strategy,
    before_first_generation,
    pick,
    reflected,
    with_first_guess,
)

FIRST_STEP = 0.3  # in widths of the box (Hansen 2016, section B.1: about a quarter, so that the optimum is within 3 s)


@dataclass(frozen=True, kw_only=True, repr=False)
class CmaState(SearchState):
    """State of CMA-ES. `population` holds the last candidates, with the best of all in place of the worst."""

    guess: Tensor  # (*problems, K, P) candidates of the first generation
    mean: Tensor  # (*problems, P), in units of the box: 0 at low, 1 at high
    step: Tensor  # (*problems) step size s
    covariance: Tensor  # (*problems, P, P)
    step_path: Tensor  # (*problems, P)
    path: Tensor  # (*problems, P)


@dataclass(frozen=True)
class CmaTrial(Proposal):
    """normal: z of each candidate. moved: A z, that is (x - m) / s."""

    normal: Tensor  # (*problems, N, P)
    moved: Tensor  # (*problems, N, P)


@dataclass(frozen=True)
class _Constants:
    """Weights and learning rates of table 1 of Hansen (2016), without negative weights."""

    weights: tuple[float, ...]
    mass: float  # mu_eff
    c_step: float
    damping: float
    c_path: float
    c_1: float
    c_mu: float
    length: float  # expected length of a normal vector

    @classmethod
    def of(cls, size: int, n: int) -> _Constants:
        raw = [math.log((size + 1) / 2) - math.log(i + 1) for i in range(size // 2)]
        weights = tuple(w / sum(raw) for w in raw)
        mass = 1.0 / sum(w * w for w in weights)
        c_step = (mass + 2) / (n + mass + 5)
        c_1 = 2 / ((n + 1.3) ** 2 + mass)
        return cls(
            weights=weights,
            mass=mass,
            c_step=c_step,
            damping=1 + 2 * max(0.0, math.sqrt((mass - 1) / (n + 1)) - 1) + c_step,
            c_path=(4 + mass / n) / (n + 4 + 2 * mass / n),
            c_1=c_1,
            c_mu=min(1 - c_1, 2 * (0.25 + mass + 1 / mass - 2) / ((n + 2) ** 2 + mass)),
            length=math.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n * n)),
        )


def init(
    low: Tensor, high: Tensor, settings: EvolutionSettings, seed: Tensor, first_guess: Tensor | None = None
) -> CmaState:
    problems, parameters = low.shape[:-1], low.shape[-1]
    size = settings.first_population(parameters)
    common = before_first_generation(low, high, settings, seed, size)
    guess = low.new_zeros((*problems, 0, parameters)) if first_guess is None else first_guess.to(low)
    guess = guess.clamp(low[..., None, :], high[..., None, :])
    population = with_first_guess(((low + high) / 2)[..., None, :].repeat_interleave(size, -2), guess)
    zeros = torch.zeros_like(low)
    mean = torch.full_like(low, 0.5) if first_guess is None else (guess[..., 0, :] - low) / _width(low, high)
    return CmaState(
        **common,
        population=population,
        guess=guess,
        mean=mean,
        step=low.new_full(problems, FIRST_STEP),
        covariance=torch.diag_embed(torch.ones_like(low)),
        step_path=zeros,
        path=zeros,
    )


def ask(state: CmaState, settings: EvolutionSettings) -> CmaTrial:
    size, parameters = state.population.shape[-2:]
    u = uniform(stream(state.seed, state.generation), size * parameters).unflatten(-1, (size, parameters))
    normal = (math.sqrt(2.0) * torch.erfinv(2.0 * u - 1.0)).to(state.low.dtype)
    moved = apply(cholesky(state.covariance)[..., None, :, :], normal)
    low, width = state.low[..., None, :], _width(state.low, state.high)[..., None, :]
    candidates = low + width * (state.mean[..., None, :] + state.step[..., None, None] * moved)
    candidates = reflected(candidates, low, state.high[..., None, :])
    if state.generation == 0 and state.guess.shape[-2]:
        given = ((state.guess - low) / width - state.mean[..., None, :]) / state.step[..., None, None]
        normal, moved = with_first_guess(normal, given), with_first_guess(moved, given)
        candidates = with_first_guess(candidates, state.guess)
    return CmaTrial(candidates, normal, moved)


def tell(state: CmaState, trial: CmaTrial, cost: Tensor, settings: EvolutionSettings) -> CmaState:
    cost, order = torch.sort(state.checked(cost), stable=True)
    updated = _adapted(state, pick(trial.normal, order), pick(trial.moved, order), cost)
    population = pick(trial.candidates, order)
    # The best candidate of all is kept in the population, but takes no part in the update.
    earlier = state.cost[..., 0] < cost[..., 0]
    population = torch.where(
        earlier[..., None, None], torch.cat((state.population[..., :1, :], population[..., :-1, :]), -2), population
    )
    cost = torch.where(earlier[..., None], torch.cat((state.cost[..., :1], cost[..., :-1]), -1), cost)
    after = replace(
        updated,
        population=population,
        cost=cost,
        generation=state.generation + 1,
        evaluations=state.evaluations + cost.shape[-1],
    )
    return after.with_progress_counters(settings)


STRATEGY = Strategy(CmaState, init, ask, tell)


def _adapted(state: CmaState, normal: Tensor, moved: Tensor, cost: Tensor) -> CmaState:
    """Mean, paths, covariance and step size after a generation, sorted by cost (Hansen 2016, equations 38 to 47).

    Candidates without a finite cost have no weight; a problem without any finite cost keeps its state.
    """
    size, n = moved.shape[-2:]
    k = _Constants.of(size, n)
    weights = moved.new_tensor(k.weights) * torch.isfinite(cost[..., : len(k.weights)])
    total = row_sum(weights)
    weights = weights / torch.where(total > 0, total, 1.0)[..., None]
    best, best_normal = moved[..., : len(k.weights), :].mT, normal[..., : len(k.weights), :].mT
    shift = row_sum(best * weights[..., None, :])
    normal_shift = row_sum(best_normal * weights[..., None, :])
    step_path = (1 - k.c_step) * state.step_path + math.sqrt(k.c_step * (2 - k.c_step) * k.mass) * normal_shift
    length = dot(step_path, step_path).sqrt()
    expected = math.sqrt(1 - (1 - k.c_step) ** (2 * (state.generation + 1))) * (1.4 + 2 / (n + 1)) * k.length
    steady = (length < expected).to(length)
    path = (1 - k.c_path) * state.path
    path = path + (steady * math.sqrt(k.c_path * (2 - k.c_path) * k.mass))[..., None] * shift
    missing = (1 - steady) * k.c_path * (2 - k.c_path)
    rank_mu = row_sum(best[..., :, None, :] * best[..., None, :, :] * weights[..., None, None, :])
    covariance = (1 - k.c_1 - k.c_mu + k.c_1 * missing)[..., None, None] * state.covariance
    covariance = covariance + k.c_1 * path[..., :, None] * path[..., None, :] + k.c_mu * rank_mu
    exponent = (k.c_step / k.damping * (length / k.length - 1)).clamp(max=1.0)
    # Factor by factor: the vectorised exponential rounds differently at the end of a tensor.
    factor = length.new_tensor([math.exp(e) for e in exponent.flatten().tolist()]).reshape(length.shape)
    judged = total > 0
    return replace(
        state,
        mean=torch.where(judged[..., None], state.mean + state.step[..., None] * shift, state.mean),
        step=torch.where(judged, state.step * factor, state.step),
        covariance=torch.where(judged[..., None, None], covariance, state.covariance),
        step_path=torch.where(judged[..., None], step_path, state.step_path),
        path=torch.where(judged[..., None], path, state.path),
    )


def cholesky(matrix: Tensor) -> Tensor:
    """Lower triangular A with A A' = matrix (..., P, P), column by column, independent of the batch.

    A pivot that rounding has made negative counts as the smallest positive one of relative rounding.
    """
    rest, columns = matrix, []
    least = torch.finfo(matrix.dtype).eps * matrix.diagonal(dim1=-2, dim2=-1).amax(-1)
    for j in range(matrix.shape[-1]):
        column = rest[..., :, j] / torch.maximum(rest[..., j, j], least).sqrt()[..., None]
        column = torch.where(torch.arange(matrix.shape[-1], device=matrix.device) >= j, column, 0.0)
        columns.append(column)
        rest = rest - column[..., :, None] * column[..., None, :]
    return torch.stack(columns, -1)


def _width(low: Tensor, high: Tensor) -> Tensor:
    """Width of the box, 1 where it is zero."""
    return torch.where(high > low, high - low, 1.0)
