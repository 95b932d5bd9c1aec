"""Differential evolution, from a box to a result: generations until every problem has a reason to stop.

The cost is `cost(candidates (L, N, P), lanes (L,)) -> (L, N)`: L problems still run, `lanes` are their places in the
flattened batch. Problems that have finished leave, which changes nothing for those that stay.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.capacity import expect_room
from fdi_torch.estimate.draws import problem_seeds
from fdi_torch.estimate.evolution_settings import EvolutionSettings
from fdi_torch.estimate.generation import State, Trial, ask, init, tell

__all__ = ["REASONS", "EvolutionResult", "EvolutionSettings", "Search", "State", "Trial", "evolve", "snapshot"]

Cost = Callable[[Tensor, Tensor], Tensor]

REASONS = ("running", "target", "converged", "stalled", "budget", "failed")
_RUNNING, _TARGET, _CONVERGED, _STALLED, _BUDGET, _FAILED = range(len(REASONS))


@dataclass(frozen=True)
class EvolutionResult:
    """What was found. Populations are best first, and NaN where L-SHADE has taken members away.

    A problem none of whose candidates had a finite cost is "failed": best is then any vector of the box, cost infinite.
    """

    best: Tensor  # (*problems, P)
    best_cost: Tensor  # (*problems)
    population: Tensor  # (*problems, N, P)
    cost: Tensor  # (*problems, N)
    generations: Tensor  # (*problems) int64
    evaluations: Tensor  # (*problems) int64
    reason: Tensor  # (*problems) int64, place in REASONS

    @property
    def converged(self) -> Tensor:
        """(*problems) bool: the population has contracted to a point, or the target was reached."""
        return (self.reason == _CONVERGED) | (self.reason == _TARGET)

    def reasons(self) -> list[str]:
        """The reason of each problem in words, flattened."""
        return [REASONS[code] for code in self.reason.flatten().tolist()]


@dataclass(frozen=True)
class Search:
    """A whole search between two generations: the running problems, which they are, and what has finished.

    It holds all that is needed to go on, bit for bit, with `evolve(..., resume=search)`.
    """

    state: State  # of the running problems, one flat leading dimension L
    lanes: Tensor  # (L,) int64
    finished: EvolutionResult  # of all problems, flat
    shape: tuple[int, ...]  # of the batch of problems

    def to_dict(self) -> dict[str, Tensor]:
        """Plain tensors; `from_dict` makes the same search of them."""
        tensors = {f"state.{name}": value for name, value in self.state.to_dict().items()}
        tensors |= {f"finished.{name}": value for name, value in vars(self.finished).items()}
        return tensors | {"lanes": self.lanes, "shape": torch.tensor(self.shape, dtype=torch.int64)}

    @classmethod
    def from_dict(cls, tensors: dict[str, Tensor]) -> Search:
        def part(prefix: str) -> dict[str, Tensor]:
            return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}

        finished = EvolutionResult(**part("finished."))
        return cls(State.from_dict(part("state.")), tensors["lanes"], finished, tuple(tensors["shape"].tolist()))


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
    """Minimises the cost of every problem within its box.

    low, high (*problems, P); seeds (*problems) int64, or one number from which they are made; first_guess
    (*problems, K, P) or (K, P). `on_generation` is called after each generation; what it raises ends the search and is
    passed on, and the `Search` it was last given can be resumed. Raises ValueError where shapes or box do not fit.
    """
    settings = settings or EvolutionSettings()
    search = _retired(resume or _begin(low, high, settings, seeds, first_guess), settings)
    while len(search.lanes):
        trial = ask(search.state, settings)
        costs = cost(trial.candidates, search.lanes)
        search = replace(search, state=tell(search.state, trial, costs, settings))
        if on_generation is not None:
            on_generation(search)
        search = _retired(search, settings)
    return snapshot(search)


def snapshot(search: Search) -> EvolutionResult:
    """The result so far, of the shape of the batch; problems still running have that as their reason."""
    running = torch.zeros_like(search.lanes)
    flat = _filed(search, torch.ones_like(search.lanes, dtype=torch.bool), running).finished
    return EvolutionResult(
        **{name: value.unflatten(0, search.shape) if search.shape else value[0] for name, value in vars(flat).items()}
    )


def stop_reason(state: State, settings: EvolutionSettings) -> Tensor:
    """(*problems) int64, place in REASONS; 0 while the problem is to go on.

    converged: members lie within `parameter_tolerance` of the box and costs within `cost_tolerance` of their scale. The
    cost itself is compared with nothing, so an offset of the cost changes no decision.
    """
    reason = torch.zeros_like(state.waited)
    if state.generation == 0:
        return reason
    best, worst = state.cost[..., 0], state.cost[..., -1]
    size = settings.population_after(state.first_population, state.evaluations)
    if state.evaluations + size > settings.evaluations:
        reason = torch.where(torch.isfinite(best), _BUDGET, _FAILED)
    reason = torch.where((state.waited >= settings.patience) & torch.isfinite(best), _STALLED, reason)
    spread = state.population.amax(-2) - state.population.amin(-2)
    together = (spread <= settings.parameter_tolerance * (state.high - state.low)).all(-1)
    level = worst - best <= settings.cost_tolerance * state.scale
    reason = torch.where(together & level, _CONVERGED, reason)
    return torch.where(best <= settings.target, _TARGET, reason)


def _begin(
    low: Tensor, high: Tensor, settings: EvolutionSettings, seeds: int | Tensor, first_guess: Tensor | None
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
    state = init(low.flatten(0, -2), high.flatten(0, -2), settings, seeds.reshape(-1), first_guess)
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
    """Members, those that have finished, the archive and the memory of what succeeded."""
    size = settings.first_population(parameters)
    archive = settings.archive_share * size if settings.strategy == "l-shade" else 0.0
    numbers = (2.0 * size + archive) * (parameters + 1) + 2.0 * settings.memory
    what = f"a search with a population of {size:.3g}, an archive of {archive:.3g} and a memory of "
    expect_room(problems * numbers, f"{what}{settings.memory:.3g}", "make them smaller")


def _retired(search: Search, settings: EvolutionSettings) -> Search:
    """The search without the problems that have a reason to stop, which are filed."""
    reason = stop_reason(search.state, settings)
    done = reason != _RUNNING
    if not bool(done.any()):
        return search
    filed = _filed(search, done, reason)
    return replace(filed, state=search.state.select(~done), lanes=search.lanes[~done])


def _filed(search: Search, done: Tensor, reason: Tensor) -> Search:
    """The search with the problems of the mask (L,) copied into `finished`."""
    state, lanes = search.state.select(done), search.lanes[done]
    missing = search.finished.cost.shape[-1] - state.cost.shape[-1]
    values = {
        "best": state.population[:, 0],
        "best_cost": state.cost[:, 0],
        "population": torch.nn.functional.pad(state.population, (0, 0, 0, missing), value=math.nan),
        "cost": torch.nn.functional.pad(state.cost, (0, missing), value=math.nan),
        "generations": torch.full_like(lanes, state.generation),
        "evaluations": torch.full_like(lanes, state.evaluations),
        "reason": reason[done],
    }
    finished = {name: old.index_copy(0, lanes, values[name]) for name, old in vars(search.finished).items()}
    return replace(search, finished=EvolutionResult(**finished))
