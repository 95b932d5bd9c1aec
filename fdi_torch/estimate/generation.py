"""One generation of differential evolution as three pure functions: `init`, `ask` and `tell`.

`init` draws the first population, `ask` proposes candidates, and `tell` takes their costs and returns the next state.
Strategies: "rand/1/bin" (Storn & Price 1997) is equations (20)-(23) of the paper that this project implements;
"l-shade" (Tanabe & Fukunaga 2014) is current-to-pbest/1/bin with a success-history memory of F and CR, an archive of
replaced parents and linear population size reduction. N: population size, P: parameters, H: memory size, A: archive
size. Leading dimensions are independent problems; the results of each are bit-for-bit those of running it alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from fdi_torch.estimate.draws import stream, uniform
from fdi_torch.estimate.evolution_settings import EvolutionSettings
from fdi_torch.estimate.shade import draw_factor, draw_rate, update_archive, update_memory
from fdi_torch.estimate.strategy import (
    Proposal,
    SearchState,
    Strategy,
    before_first_generation,
    halfway,
    pick,
    with_first_guess,
)

_VARIATION, _ARCHIVE = 0, 2  # indices of the random streams of one generation


@dataclass(frozen=True, kw_only=True, repr=False)
class State(SearchState):
    """State of differential evolution.

    memory_f, memory_cr: success-history memories; memory_cell: the cell to be overwritten next.
    archive: replaced parents, of which the first `archived` rows are in use.
    """

    memory_f: Tensor  # (*problems, H)
    memory_cr: Tensor  # (*problems, H)
    memory_cell: Tensor  # (*problems) int64
    archive: Tensor  # (*problems, A, P)
    archived: Tensor  # (*problems) int64


@dataclass(frozen=True)
class Trial(Proposal):
    """Candidates to be evaluated, with the factor F and the crossover rate CR that each was made with."""

    factor: Tensor  # (*problems, N)
    rate: Tensor  # (*problems, N)


def init(
    low: Float[Tensor, "*problems P"],
    high: Float[Tensor, "*problems P"],
    settings: EvolutionSettings,
    seed: Int[Tensor, "*problems"],
    first_guess: Float[Tensor, "*problems G P"] | None = None,
) -> State:
    """Draw the first population uniformly in the box, low + rand(0, 1) (high - low), not yet evaluated. (20)

    Raises ValueError for an empty or infinite box, mismatched shapes and a budget below the population size.
    """
    problems, parameters = low.shape[:-1], low.shape[-1]
    size = settings.first_population(parameters)
    common = before_first_generation(low, high, settings, seed, size)
    draws = uniform(stream(seed, 0, _VARIATION), size * parameters).to(low.dtype).unflatten(-1, (size, parameters))
    low_, high_ = low[..., None, :], high[..., None, :]
    population = (low_ + draws * (high_ - low_)).clamp(low_, high_)
    if first_guess is not None:
        population = with_first_guess(population, first_guess.to(low).clamp(low_, high_))
    cells = settings.memory if settings.strategy == "l-shade" else 0
    return State(
        **common,
        population=population,
        memory_f=low.new_full((*problems, cells), 0.5),
        memory_cr=low.new_full((*problems, cells), 0.5),
        memory_cell=torch.zeros_like(seed),
        archive=low.new_zeros((*problems, settings.archive_size(size), parameters)),
        archived=torch.zeros_like(seed),
    )


def ask(state: State, settings: EvolutionSettings) -> Trial:
    """Propose the next candidates (*problems, N, P): the first population itself, later on mutation and crossover.

    Binomial crossover: a component comes from the mutant with probability CR, and at least one always does. (22)
    """
    if state.generation == 0:
        zeros = torch.zeros_like(state.cost)
        return Trial(state.population, zeros, zeros)
    size, parameters = state.population.shape[-2:]
    rows = 4 if settings.strategy == "rand/1/bin" else 7
    u = uniform(stream(state.seed, state.generation, _VARIATION), size * (rows + parameters))
    per_member, per_component = u.split((size * rows, size * parameters), -1)
    q, *others = per_member.unflatten(-1, (rows, size)).unbind(-2)
    mutant, factor, rate = (_rand_1 if settings.strategy == "rand/1/bin" else _to_p_best_1)(state, settings, others)
    mutant = halfway(mutant, state.population, state.low[..., None, :], state.high[..., None, :])
    crossed = per_component.unflatten(-1, (size, parameters)) <= rate[..., None]
    crossed |= torch.arange(parameters, device=u.device) == (q * parameters).long()[..., None]
    return Trial(torch.where(crossed, mutant, state.population), factor, rate)


def _rand_1(state: State, settings: EvolutionSettings, u: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Mutants theta_j + F (theta_k - theta_l), with i, j, k, l mutually different. (21)"""
    size = state.population.shape[-2]
    i = torch.arange(size, device=u[0].device)
    j = draw_other(u[0], size, i)
    k = draw_other(u[1], size, i, j)
    m = draw_other(u[2], size, i, j, k)
    factor = torch.full_like(state.cost, settings.factor)
    step = pick(state.population, k).sub_(pick(state.population, m)).mul_(settings.factor)
    return step.add_(pick(state.population, j)), factor, torch.full_like(state.cost, settings.rate)


def _to_p_best_1(state: State, settings: EvolutionSettings, u: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Mutants x_i + F (x_pbest - x_i) + F (x_r1 - x_r2), with x_r2 from population or archive. (L-SHADE, 3)"""
    population, size = state.population, state.population.shape[-2]
    u_cell, u_factor, u_rate, u_best, u_1, u_2 = u
    cell = (u_cell * settings.memory).long()
    factor = draw_factor(state.memory_f.gather(-1, cell), u_factor.to(state.cost.dtype))
    rate = draw_rate(state.memory_cr.gather(-1, cell), u_rate.to(state.cost.dtype))
    best = (u_best * max(2, round(settings.best_share * size))).long()
    i = torch.arange(size, device=u_1.device)
    r_1 = draw_other(u_1, size, i)
    r_2 = draw_other(u_2, size + state.archived[..., None], i, r_1)
    step = pick(population, best).sub_(population).add_(pick(population, r_1)).sub_(_pick_of_two(state, r_2))
    return step.mul_(factor[..., None]).add_(population), factor, rate


def _pick_of_two(state: State, index: Tensor) -> Tensor:
    """Rows `index` (*problems, N) of the population followed by the archive.

    The two are not concatenated, because that copy would dominate the cost of a generation.
    """
    size, room = state.population.shape[-2], state.archive.shape[-2]
    member = pick(state.population, index.clamp(max=size - 1))
    if not room:
        return member
    return torch.where((index < size)[..., None], member, pick(state.archive, (index - size).clamp(min=0)))


def draw_other(u: Tensor, size: int | Tensor, *taken: Tensor) -> Tensor:
    """Integers uniform on 0..size-1, excluding those in `taken`, which are mutually different; all (*problems, N)."""
    index = (u * (size - len(taken))).long()
    for value in _ascending(list(taken)):
        index = index + (index >= value)
    return index


def _ascending(values: list[Tensor]) -> list[Tensor]:
    """Sort elementwise across the list, by bubble sort: there are at most three tensors."""
    for end in range(len(values) - 1, 0, -1):
        for a in range(end):
            values[a], values[a + 1] = torch.minimum(values[a], values[a + 1]), torch.maximum(values[a], values[a + 1])
    return values


def tell(state: State, trial: Trial, cost: Float[Tensor, "*problems N"], settings: EvolutionSettings) -> State:
    """Select between parents and candidates, update the memories and sort the population. (23)

    cost (*problems, N): costs of the candidates; one that is not finite never replaces its parent.
    """
    cost = state.checked(cost)
    better = cost < state.cost
    # In L-SHADE a candidate of equal cost replaces its parent too, so that the population can cross plateaus.
    replaces = better if settings.strategy == "rand/1/bin" else (cost <= state.cost) & torch.isfinite(cost)
    updated = state
    if settings.strategy == "l-shade" and state.generation > 0:
        updated = _with_updated_memory(state, trial, state.cost - cost, better)
    selected = replace(
        updated,
        population=torch.where(replaces[..., None], trial.candidates, state.population),
        cost=torch.where(replaces, cost, state.cost),
        generation=state.generation + 1,
        evaluations=state.evaluations + state.cost.shape[-1],
    )
    return _sorted_and_reduced(selected, settings).with_progress_counters(settings)


def _with_updated_memory(state: State, trial: Trial, gain: Tensor, success: Tensor) -> State:
    memory_f, memory_cr, cell = update_memory(
        state.memory_f, state.memory_cr, state.memory_cell, trial.factor, trial.rate, gain, success
    )
    archive, archived = state.archive, state.archived
    if archive.shape[-2]:
        u = uniform(stream(state.seed, state.generation, _ARCHIVE), success.shape[-1])
        archive, archived = update_archive(archive, archived, state.population, success, u)
    return replace(state, memory_f=memory_f, memory_cr=memory_cr, memory_cell=cell, archive=archive, archived=archived)


def _sorted_and_reduced(state: State, settings: EvolutionSettings) -> State:
    """Sort the members, best first, and drop the worst ones as the population size shrinks."""
    size = min(state.cost.shape[-1], settings.population_after(state.first_population, state.evaluations))
    cost, order = torch.sort(state.cost, stable=True)
    archive_size = min(state.archive.shape[-2], settings.archive_size(size))
    return replace(
        state,
        population=pick(state.population, order[..., :size]),
        cost=cost[..., :size].contiguous(),
        archive=state.archive[..., :archive_size, :].contiguous(),
        archived=state.archived.clamp(max=archive_size),
    )


STRATEGY = Strategy(State, init, ask, tell)
"""The strategies `rand/1/bin` and `l-shade`, which the settings distinguish."""
