"""CPU seconds to find a noise-free fault of five parameters (10 s steps, 11 samples) to 1e-6, at a few seeds."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import torch

from benchmarks import simulators
from benchmarks.simulators import experiment, plant
from fdi_torch.estimate.evolution import EvolutionSettings, evolve
from fdi_torch.estimate.levenberg_marquardt import levenberg_marquardt
from fdi_torch.estimate.objectives import Problem, Term
from fdi_torch.simulate.compiled_engine import CompiledEngine
from fdi_torch.simulate.engine import Readings

TRUTH = np.array([0.1, 0.6, 0.5, 0.7, 0.9])
STEP, GOAL, SEEDS = 10.0, 1e-6, (0, 1, 2)
LOW, HIGH = np.array([0.0, -1.0, 0.0, 0.0, 0.0]), np.ones(5)
MEMBERS, GENERATIONS = 60, 1500


def fdi_hybrid() -> Callable[[int], np.ndarray]:
    """Differential evolution on the likelihood, then bounded Levenberg-Marquardt."""
    network, space = plant()
    engine = CompiledEngine(network, space, experiment(STEP))
    values = engine.readings(torch.from_numpy(TRUTH))
    data = Readings(values, torch.ones_like(values))
    problem = Problem(space, [Term(engine, data, torch.arange(5))], "likelihood")
    low, high = torch.from_numpy(LOW), torch.from_numpy(HIGH)

    def run(seed: int) -> np.ndarray:
        found = evolve(problem.cost, low[None], high[None], EvolutionSettings(), seed)
        return levenberg_marquardt(problem.linearise, found.best, low, high).theta[0].numpy()

    return run


def scipy_evolution() -> Callable[[int], np.ndarray]:
    """scipy.optimize.differential_evolution with its own polishing, each cost one LSODA run."""
    from scipy.optimize import differential_evolution

    simulate = simulators.scipy_lsoda(1e-9)
    values = simulate(TRUTH[None])

    def cost(theta: np.ndarray) -> float:
        return float(((simulate(theta[None]) - values) ** 2).sum())

    bounds = list(zip(LOW, HIGH, strict=True))
    return lambda seed: differential_evolution(cost, bounds, rng=seed, popsize=12, tol=1e-12, maxiter=120).x


def evosax_evolution() -> Callable[[int], np.ndarray]:
    """evosax' differential evolution, the population simulated by JAX."""
    jax, jnp = simulators.load_jax()
    from evosax.algorithms import DifferentialEvolution

    simulate = simulators.jax_scan_traced(STEP)
    values = simulate(jnp.asarray(TRUTH)[None])[0]
    low, high = jnp.asarray(LOW), jnp.asarray(HIGH)
    algorithm = DifferentialEvolution(population_size=MEMBERS, solution=low)
    settings = algorithm.default_params

    def cost(members):  # type: ignore[no-untyped-def]
        return jnp.sum((simulate(jnp.clip(members, low, high)) - values) ** 2, axis=(1, 2))

    @jax.jit
    def search(key):  # type: ignore[no-untyped-def]
        members = low + (high - low) * jax.random.uniform(key, (MEMBERS, 5), dtype=low.dtype)
        state = algorithm.init(key, members, cost(members), settings)

        def generation(state, key):  # type: ignore[no-untyped-def]
            first, second = jax.random.split(key)
            members, state = algorithm.ask(first, state, settings)
            state, _ = algorithm.tell(second, members, cost(members), state, settings)
            return state, None

        state, _ = jax.lax.scan(generation, state, jax.random.split(key, GENERATIONS))
        return jnp.clip(state.best_solution, low, high)

    return lambda seed: np.asarray(search(jax.random.key(seed)))


def evox_evolution() -> Callable[[int], np.ndarray]:
    """EvoX' differential evolution on torch, the population simulated by one RK4 step of plain torch, compiled."""
    from evox.algorithms import DE
    from evox.core import Problem as Task
    from evox.workflows import StdWorkflow

    simulate = simulators.torch_compiled_step(STEP)
    values = simulate(TRUTH[None])
    low, high = torch.from_numpy(LOW), torch.from_numpy(HIGH)

    class Misfit(Task):
        def evaluate(self, members: torch.Tensor) -> torch.Tensor:
            return torch.from_numpy(((simulate(members.numpy()) - values) ** 2).sum(axis=(1, 2)))

    def run(seed: int) -> np.ndarray:
        torch.manual_seed(seed)
        algorithm = DE(MEMBERS, low, high)
        workflow = StdWorkflow(algorithm, Misfit())
        workflow.init_step()
        for _ in range(GENERATIONS):
            workflow.step()
        return algorithm.pop[int(algorithm.fit.argmin())].numpy()

    return run


SEARCHERS: dict[str, Callable[[], Callable[[int], np.ndarray]]] = {
    "fdi_torch, hybrid": fdi_hybrid,
    "evosax DE + JAX": evosax_evolution,
    "EvoX DE + torch.compile": evox_evolution,
    "SciPy differential_evolution + LSODA": scipy_evolution,
}
Row = tuple[str, float, float]


def measure(budget: float) -> list[Row]:
    """Name, mean CPU seconds and worst error over the seeds; the first call of each is left out, as it compiles."""
    rows: list[Row] = []
    for name, make in SEARCHERS.items():
        try:
            run = make()
        except ImportError:
            continue
        seeds = SEEDS[:1] if "SciPy" in name else SEEDS
        if "SciPy" not in name:
            run(99)
        start = time.process_time()
        error = max(float(np.abs(run(seed) - TRUTH).max()) for seed in seeds)
        rows.append((name, (time.process_time() - start) / len(seeds), error))
    return rows


def table(rows: list[Row]) -> str:
    lines = ["| search | CPU seconds | worst error | over ours | reaches 1e-6 |", "|---|---|---|---|---|"]
    ours = rows[0][1]
    return "\n".join(
        lines + [f"| {n} | {s:.2f} | {e:.0e} | {s / ours:.1f} | {'yes' if e < GOAL else 'no'} |" for n, s, e in rows]
    )
