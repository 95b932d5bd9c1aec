"""What a search strategy is: three functions on a state, `init`, `ask` and `tell`, that see only costs and bounds.

A strategy is used by `evolve`, or alone:

    strategy = strategy_named("cma_es")
    state = strategy.init(low, high, settings, seed)
    while ...:
        trial = strategy.ask(state, settings)
        state = strategy.tell(state, trial, cost(trial.candidates), settings)

N: population size, P: parameters. Leading dimensions are independent problems. The results of each must be bit-for-bit
those of running it alone: random numbers therefore come from `draws`, and sums from `batch_algebra`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from importlib import import_module
from typing import Any, Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from fdi_torch.estimate.evolution_settings import STRATEGIES, EvolutionSettings


@dataclass(frozen=True, kw_only=True, repr=False)
class SearchState:
    """What every strategy keeps. Members are sorted, best first; one without a valid cost has an infinite one.

    scale: largest difference between median and best cost of any generation so far. Cost tolerances are relative to it,
    which makes them independent of a constant offset of the cost.
    anchor: best cost at the last significant improvement; waited: generations since then.
    """

    population: Tensor  # (*problems, N, P)
    cost: Tensor  # (*problems, N)
    low: Tensor  # (*problems, P)
    high: Tensor  # (*problems, P)
    seed: Tensor  # (*problems) int64
    scale: Tensor  # (*problems)
    anchor: Tensor  # (*problems)
    waited: Tensor  # (*problems) int64
    first_population: int
    generation: int = 0
    evaluations: int = 0

    def __repr__(self) -> str:
        best = f"{float(self.cost.min()):.6g}" if self.cost.numel() else "none"
        return (
            f"{self.low[..., 0].numel()} problems, {self.low.shape[-1]} parameters, generation {self.generation}, "
            f"best cost {best}"
        )

    def select(self, keep: Tensor) -> Self:
        """The problems selected by the mask `keep` (*problems), with one flat leading dimension."""
        chosen: dict[str, Any] = {name: value[keep] for name, value in vars(self).items() if isinstance(value, Tensor)}
        return replace(self, **chosen)

    def checked(self, cost: Tensor) -> Tensor:
        """The costs of the candidates, infinite where they are not finite. Raises ValueError for another shape."""
        if cost.shape != self.cost.shape:
            raise ValueError(
                f"expected costs {tuple(self.cost.shape)}, got {tuple(cost.shape)}; one for each candidate"
            )
        return torch.where(torch.isfinite(cost), cost, torch.inf).to(self.cost.dtype)

    def with_progress_counters(self, settings: EvolutionSettings) -> Self:
        """The state after a generation; `waited` counts those since the last improvement of the best cost."""
        best, median = self.cost[..., 0], self.cost[..., self.cost.shape[-1] // 2]
        difference = torch.where(torch.isfinite(median), median - best, 0.0)
        scale = torch.maximum(self.scale, difference)
        improved = best < self.anchor - settings.cost_tolerance * scale
        return replace(
            self,
            scale=scale,
            anchor=torch.where(improved, best, self.anchor),
            waited=torch.where(improved, 0, self.waited + 1),
        )

    def to_dict(self) -> dict[str, Tensor]:
        """The state as plain tensors; `from_dict` restores it bit for bit."""
        return {name: torch.as_tensor(value) for name, value in vars(self).items()}

    @classmethod
    def from_dict(cls, tensors: dict[str, Tensor]) -> Self:
        values: dict[str, Any] = {f.name: tensors[f.name] for f in fields(cls)}
        counts = {name: int(values[name]) for name in ("first_population", "generation", "evaluations")}
        return cls(**(values | counts))


@dataclass(frozen=True)
class Proposal:
    """Candidates to be evaluated, all within the box."""

    candidates: Tensor  # (*problems, N, P)


@dataclass(frozen=True)
class Strategy:
    """A search strategy: the type of its state, and three functions of it.

    init(low, high, settings, seed, first_guess): the state before the first generation, in the box low, high
    (*problems, P), with seeds (*problems) int64; first_guess (*problems, K, P), K <= N, or None: candidates of that
    generation. ask(state, settings): the next candidates (*problems, N, P), a `Proposal`. tell(state, trial, cost,
    settings): the next state from the costs (*problems, N) of the candidates; a cost that is not finite never wins.
    """

    state: type[SearchState]
    init: Callable[..., Any]
    ask: Callable[..., Any]
    tell: Callable[..., Any]


def strategy_named(name: str) -> Strategy:
    """The strategy of this name in `STRATEGIES`."""
    strategy: Strategy = import_module(f"fdi_torch.estimate.{STRATEGIES[name][0]}").STRATEGY
    return strategy


def state_from_dict(tensors: dict[str, Tensor]) -> SearchState:
    """The state of whichever strategy wrote these tensors. Raises ValueError if none did."""
    for name in STRATEGIES:
        kind = strategy_named(name).state
        if {f.name for f in fields(kind)} == tensors.keys():
            return kind.from_dict(tensors)
    raise ValueError(f"expected the state of a search, got {', '.join(sorted(tensors))}; start the search again")


def before_first_generation(
    low: Tensor, high: Tensor, settings: EvolutionSettings, seed: Tensor, size: int
) -> dict[str, Any]:
    """The fields of `SearchState`, without the population of `size` members, before any cost is known.

    Raises ValueError for an empty or infinite box, mismatched shapes and a budget below the population size.
    """
    _check_box(low, high, settings, seed, size)
    problems = low.shape[:-1]
    return {
        "cost": low.new_full((*problems, size), torch.inf),
        "low": low,
        "high": high,
        "seed": seed,
        "scale": low.new_zeros(problems),
        "anchor": low.new_full(problems, torch.inf),
        "waited": torch.zeros_like(seed),
        "first_population": size,
    }


def _check_box(low: Tensor, high: Tensor, settings: EvolutionSettings, seed: Tensor, size: int) -> None:
    if low.shape != high.shape or low.shape[:-1] != seed.shape:
        raise ValueError(
            f"expected low and high (*problems, P) and seeds (*problems), got {tuple(low.shape)}, {tuple(high.shape)} "
            f"and {tuple(seed.shape)}; broadcast them first"
        )
    if not bool((torch.isfinite(low) & torch.isfinite(high) & (low <= high)).all()):
        raise ValueError(
            "expected a finite box low <= high for every parameter, got one that is infinite or empty; give it a range"
        )
    if size > settings.evaluations:
        raise ValueError(
            f"expected a budget of at least the population of {size}, got {settings.evaluations} evaluations; raise it"
        )


def with_first_guess(
    population: Float[Tensor, "*problems N P"], guess: Float[Tensor, "*problems G P"]
) -> Float[Tensor, "*problems N P"]:
    """The population (*problems, N, P) whose first members are replaced by the guesses (*problems, K, P)."""
    if guess.shape[-2] > population.shape[-2]:
        raise ValueError(
            f"expected at most {population.shape[-2]} first guesses (the population), got {guess.shape[-2]}; give fewer"
        )
    return torch.cat((guess, population[..., guess.shape[-2] :, :]), -2)


def pick(rows: Float[Tensor, "*problems M P"], index: Int[Tensor, "*problems K"]) -> Float[Tensor, "*problems K P"]:
    """Copy the rows `index` (*problems, K) of `rows` (*problems, M, P) into a new tensor (*problems, K, P)."""
    problem = torch.arange(index[..., 0].numel(), device=index.device).reshape(*index.shape[:-1], 1)
    flat = (index + problem * rows.shape[-2]).reshape(-1)
    return rows.reshape(-1, rows.shape[-1]).index_select(0, flat).reshape(*index.shape, rows.shape[-1])


def halfway(theta: Tensor, parent: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Midpoint between the parent and the violated bound (Zhang & Sanderson 2009, JADE; Tanabe & Fukunaga 2014).

    parent: the vector inside the box that `theta` was made from.
    """
    return _where_outside(theta, (torch.where(theta < low, low, high) + parent) / 2.0, low, high)


def reflected(theta: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Reflection at the bounds, as often as needed."""
    width = high - low
    turns = torch.remainder((theta - low) / torch.where(width > 0, width, 1.0), 2.0)
    return _where_outside(theta, low + width * torch.where(turns > 1.0, 2.0 - turns, turns), low, high)


def _where_outside(theta: Tensor, repaired: Tensor, low: Tensor, high: Tensor) -> Tensor:
    # The clamp removes rounding errors: low + 1.0 * width may exceed high.
    return torch.where((theta < low) | (theta > high), repaired.clamp(low, high), theta)
