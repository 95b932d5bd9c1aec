"""Search of a batch of independent problems, run until each meets a stopping criterion.

The cost function is `cost(candidates (L, N, P), lanes (L,)) -> (L, N)` for the L problems that are still running, whose
indices in the flattened batch are `lanes`. A stopped problem drops out without affecting the results of the others.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from fdi_torch.capacity import expect_room
from fdi_torch.estimate.draws import problem_seeds
from fdi_torch.estimate.evolution_settings import EvolutionSettings
from fdi_torch.estimate.strategy import SearchState, Strategy, state_from_dict, strategy_named

__all__ = ["REASONS", "EvolutionResult", "EvolutionSettings", "Search", "distant_members", "evolve", "snapshot"]

Cost = Callable[[Tensor, Tensor], Tensor]

APART = 0.05  # share of the box's width, see `distant_members`
REASONS = ("running", "target", "converged", "stalled", "budget", "failed")
_RUNNING, _TARGET, _CONVERGED, _STALLED, _BUDGET, _FAILED = range(len(REASONS))


@dataclass(frozen=True)
class EvolutionResult:
    """Result of the search. Populations are sorted, best first, and padded with NaN where L-SHADE removed members.

    A problem is "failed" if no candidate had a finite cost; `best` is then an arbitrary vector of the box and
    `best_cost` is infinite.
    """

    best: Tensor  # (*problems, P)
    best_cost: Tensor  # (*problems)
    population: Tensor  # (*problems, N, P)
    cost: Tensor  # (*problems, N)
    generations: Tensor  # (*problems) int64
    evaluations: Tensor  # (*problems) int64
    reason: Tensor  # (*problems) int64, index into REASONS

    def __repr__(self) -> str:
        counts = Counter(self.reasons())
        reasons = ", ".join(f"{count} {reason}" for reason, count in counts.items())
        return f"EvolutionResult: {self.reason.numel()} problems, {self.best.shape[-1]} parameters; {reasons}"

    @property
    def converged(self) -> Tensor:
        """Whether the population contracted to a point or reached the target, (*problems) bool."""
        return (self.reason == _CONVERGED) | (self.reason == _TARGET)

    def reasons(self) -> list[str]:
        """Stopping reason of each problem by name, flattened."""
        return [REASONS[code] for code in self.reason.flatten().tolist()]


@dataclass(frozen=True)
class Search:
    """Snapshot of a search between two generations: the running problems and the results of the finished ones.

    `evolve(..., resume=search)` continues from it bit for bit.
    """

    state: SearchState  # of the running problems, one flat leading dimension L
    lanes: Tensor  # (L,) int64
    finished: EvolutionResult  # of all problems, flat
    shape: tuple[int, ...]  # of the batch of problems

    def __repr__(self) -> str:
        return f"Search of {self.finished.reason.numel()} problems; running: {self.state!r}"

    def to_dict(self) -> dict[str, Tensor]:
        """The search as plain tensors; `from_dict` restores it."""
        tensors = {f"state.{name}": value for name, value in self.state.to_dict().items()}
        tensors |= {f"finished.{name}": value for name, value in vars(self.finished).items()}
        return tensors | {"lanes": self.lanes, "shape": torch.tensor(self.shape, dtype=torch.int64)}

    @classmethod
    def from_dict(cls, tensors: dict[str, Tensor]) -> Search:
        def part(prefix: str) -> dict[str, Tensor]:
            return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}

        finished = EvolutionResult(**part("finished."))
        return cls(state_from_dict(part("state.")), tensors["lanes"], finished, tuple(tensors["shape"].tolist()))


def evolve(
    cost: Cost,
    low: Tensor,
    high: Tensor,
    settings: EvolutionSettings | None = None,
    seeds: int | Tensor = 0,
    *,
    first_guess: Tensor | None = None,
    on_generation: Callable[[Search], None] | None = None,
    resume: Search | None = None,
) -> EvolutionResult:
    """Minimise the cost of every problem within its box.

    low, high (*problems, P). seeds: (*problems) int64, or one number from which they are derived. first_guess
    (*problems, K, P) or (K, P): replaces the first K members. on_generation: called after each generation; an exception
    that it raises ends the search and propagates, and the last `Search` that it received can be resumed.
    Raises ValueError for mismatched shapes or an invalid box.
    """
    settings = settings or EvolutionSettings()
    strategy = strategy_named(settings.strategy)
    search = _without_stopped(resume or _begin(strategy, low, high, settings, seeds, first_guess), settings)
    while len(search.lanes):
        trial = strategy.ask(search.state, settings)
        costs = cost(trial.candidates, search.lanes)
        search = replace(search, state=strategy.tell(search.state, trial, costs, settings))
        if on_generation is not None:
            on_generation(search)
        search = _without_stopped(search, settings)
    return snapshot(search)


def snapshot(search: Search) -> EvolutionResult:
    """The result so far, in the shape of the batch; problems that are not finished have the reason "running"."""
    running = torch.zeros_like(search.lanes)
    flat = _with_results(search, torch.ones_like(search.lanes, dtype=torch.bool), running).finished
    return EvolutionResult(
        **{name: value.unflatten(0, search.shape) if search.shape else value[0] for name, value in vars(flat).items()}
    )


def distant_members(
    population: Float[Tensor, "B N P"], cost: Float[Tensor, "B N"], width: Float[Tensor, " P"], count: int
) -> Float[Tensor, "B K P"]:
    """The best members (B, K, P) of populations (B, N, P), sorted by cost, that differ from each other; K = count.

    Two members differ if they are further apart than `APART` times the box's width in some parameter. If too few
    differ, the best is repeated.
    """
    usable = torch.isfinite(cost) & torch.isfinite(population).all(-1)
    chosen = [population[:, 0]]
    for _ in range(count - 1):
        near = torch.stack([((population - c[:, None]) / width).abs().amax(-1) <= APART for c in chosen]).any(0)
        differs = usable & ~near
        next_best = population[torch.arange(len(population)), differs.to(torch.int8).argmax(-1)]
        chosen.append(torch.where(differs.any(-1)[:, None], next_best, chosen[0]))
    return torch.stack(chosen, dim=1)


def stop_reason(state: SearchState, settings: EvolutionSettings) -> Int[Tensor, "*problems"]:
    """Stopping reason of each problem, (*problems) int64, an index into REASONS; 0 while it runs.

    converged: the range of the members is at most `parameter_tolerance` times the box's width in every parameter, and
    the range of their costs at most `cost_tolerance` times `SearchState.scale`. Only cost differences enter this
    criterion, so a constant offset of the cost has no effect on it.
    """
    reason = torch.zeros_like(state.waited)
    if state.generation == 0:
        return reason
    best, worst = state.cost[..., 0], state.cost[..., -1]
    size = settings.population_after(state.first_population, state.evaluations)
    if state.evaluations + size > settings.evaluations:
        reason = torch.where(torch.isfinite(best), _BUDGET, _FAILED)
    reason = torch.where((state.waited >= settings.patience) & torch.isfinite(best), _STALLED, reason)
    ranges = state.population.amax(-2) - state.population.amin(-2)
    contracted = (ranges <= settings.parameter_tolerance * (state.high - state.low)).all(-1)
    costs_agree = worst - best <= settings.cost_tolerance * state.scale
    reason = torch.where(contracted & costs_agree, _CONVERGED, reason)
    return torch.where(best <= settings.target, _TARGET, reason)


def _begin(
    strategy: Strategy,
    low: Tensor,
    high: Tensor,
    settings: EvolutionSettings,
    seeds: int | Tensor,
    first_guess: Tensor | None,
) -> Search:
    shape = tuple(low.shape[:-1])
    if not shape:
        low, high = low[None], high[None]
    if isinstance(seeds, int):
        seeds = problem_seeds(seeds, shape, low.device)
    if first_guess is not None:
        first_guess = first_guess.expand(*shape, *first_guess.shape[-2:]).reshape(-1, *first_guess.shape[-2:])
    parameters = low.shape[-1]
    _expect_room(low.shape[:-1].numel(), parameters, settings)
    state = strategy.init(low.flatten(0, -2), high.flatten(0, -2), settings, seeds.reshape(-1), first_guess)
    count, size = state.cost.shape
    finished = EvolutionResult(
        best=low.new_full((count, parameters), math.nan),
        best_cost=low.new_full((count,), math.inf),
        population=low.new_full((count, size, parameters), math.nan),
        cost=low.new_full((count, size), math.nan),
        generations=torch.zeros_like(state.seed),
        evaluations=torch.zeros_like(state.seed),
        reason=torch.zeros_like(state.seed),
    )
    return Search(state, torch.arange(count, device=low.device), finished, shape)


def _expect_room(problems: int, parameters: int, settings: EvolutionSettings) -> None:
    """Check that populations (running and finished), archives and success-history memories fit into the memory."""
    size = settings.first_population(parameters)
    archive = settings.archive_share * size if settings.strategy == "l-shade" else 0.0
    numbers = (2.0 * size + archive) * (parameters + 1) + 2.0 * settings.memory
    what = f"a search with a population of {size:.3g}, an archive of {archive:.3g} and a memory of "
    expect_room(problems * numbers, f"{what}{settings.memory:.3g}", "make them smaller")


def _without_stopped(search: Search, settings: EvolutionSettings) -> Search:
    """Move the problems that meet a stopping criterion from the running ones to the results."""
    reason = stop_reason(search.state, settings)
    stopped = reason != _RUNNING
    if not bool(stopped.any()):
        return search
    updated = _with_results(search, stopped, reason)
    return replace(updated, state=search.state.select(~stopped), lanes=search.lanes[~stopped])


def _with_results(search: Search, selected: Tensor, reason: Tensor) -> Search:
    """Copy the running problems of the mask (L,) into `finished`."""
    state, lanes = search.state.select(selected), search.lanes[selected]
    missing = search.finished.cost.shape[-1] - state.cost.shape[-1]
    values = {
        "best": state.population[:, 0],
        "best_cost": state.cost[:, 0],
        "population": torch.nn.functional.pad(state.population, (0, 0, 0, missing), value=math.nan),
        "cost": torch.nn.functional.pad(state.cost, (0, missing), value=math.nan),
        "generations": torch.full_like(lanes, state.generation),
        "evaluations": torch.full_like(lanes, state.evaluations),
        "reason": reason[selected],
    }
    finished = {name: old.index_copy(0, lanes, values[name]) for name, old in vars(search.finished).items()}
    return replace(search, finished=EvolutionResult(**finished))
