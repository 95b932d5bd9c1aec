"""Settings of the search."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

# Name of each strategy -> module in `estimate` whose `STRATEGY` it is, and its default population for P parameters.
STRATEGIES: dict[str, tuple[str, Callable[[int], int]]] = {
    "rand/1/bin": ("generation", lambda parameters: 10 * parameters),
    "l-shade": ("generation", lambda parameters: 18 * parameters),
    "cma_es": ("cma_es", lambda parameters: 4 + int(3.0 * math.log(parameters))),
}


@dataclass(frozen=True)
class EvolutionSettings:
    """Settings of the search: first those of all strategies, then those of each one.

    population: number of members N; None: that of `STRATEGIES`. More are safer where the cost has several minima.
    evaluations: budget of cost evaluations per problem.
    parameter_tolerance: relative to the box's width; cost_tolerance: relative to the scale of the costs,
    `SearchState.scale`.
    patience: number of generations without improvement after which a problem has stalled.
    target: cost at which the search stops. factor, rate: F and CR.
    memory, best_share, archive_share, smallest: H, p, r_arc and N_min of Tanabe & Fukunaga (2014).
    """

    strategy: str = "l-shade"
    population: int | None = None
    evaluations: int = 20_000
    parameter_tolerance: float = 1e-6
    cost_tolerance: float = 1e-9
    patience: int = 200
    target: float = -math.inf
    # rand/1/bin
    factor: float = 0.5
    rate: float = 0.9
    # l-shade
    memory: int = 6
    best_share: float = 0.11
    archive_share: float = 2.6
    smallest: int = 4

    def __post_init__(self) -> None:
        _expect(self.strategy in STRATEGIES, f"strategy to be one of {', '.join(STRATEGIES)}", self.strategy)
        _expect(self.population is None or self.population >= 4, "a population of at least 4", self.population)
        _expect(self.smallest >= 4, "smallest (population) of at least 4", self.smallest)
        _expect(self.evaluations >= 4, "a budget of at least 4 evaluations", self.evaluations)
        _expect(self.patience >= 1, "a patience of at least 1 generation", self.patience)
        _expect(self.memory >= 1, "a memory of at least 1 cell", self.memory)
        _expect(0.0 <= self.factor <= 2.0, "factor (F) in [0, 2]", self.factor)
        _expect(0.0 <= self.rate <= 1.0, "rate (CR) in [0, 1]", self.rate)
        _expect(0.0 < self.best_share <= 1.0, "best_share (p) in (0, 1]", self.best_share)
        _expect(0.0 <= self.archive_share < math.inf, "a finite archive_share of at least 0", self.archive_share)
        _expect(not math.isnan(self.target), "target to be a number", self.target)
        _expect(self.parameter_tolerance >= 0.0, "parameter_tolerance of at least 0", self.parameter_tolerance)
        _expect(self.cost_tolerance >= 0.0, "cost_tolerance of at least 0", self.cost_tolerance)

    def first_population(self, parameters: int) -> int:
        return self.population or STRATEGIES[self.strategy][1](max(parameters, 1))

    def population_after(self, first: int, evaluations: int) -> int:
        """Population size of the next generation: constant, or linear in the evaluations (L-SHADE, equation 10)."""
        if self.strategy != "l-shade" or first <= self.smallest:
            return first
        fraction = min(1.0, evaluations / self.evaluations)
        return round(first + (self.smallest - first) * fraction)

    def archive_size(self, population: int) -> int:
        return round(self.archive_share * population) if self.strategy == "l-shade" else 0


def _expect(condition: bool, expected: str, actual: object) -> None:
    if not condition:
        raise ValueError(f"expected {expected}, got {actual}; change the search settings")
