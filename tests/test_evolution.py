"""Search strategies: each finds known optima, keeps its rules, and a problem never feels its neighbours."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from scipy import stats
from torch import Tensor

from fdi_torch.estimate.draws import stream, uniform
from fdi_torch.estimate.evolution import REASONS, EvolutionSettings, Search, evolve, snapshot, stop_reason
from fdi_torch.estimate.evolution_settings import STRATEGIES
from fdi_torch.estimate.generation import ask, draw_other, init, tell
from fdi_torch.estimate.strategy import state_from_dict, strategy_named

DOUBLE = torch.float64
RAND_1 = EvolutionSettings("rand/1/bin", population=50, evaluations=60_000, factor=0.55)
L_SHADE = EvolutionSettings("l-shade", population=80, evaluations=30_000)
LARGE, SMALL = 200, 50  # several minima need large populations (Hansen and Kern 2004, figure 2)
CMA_ES = EvolutionSettings("cma_es", population=LARGE, evaluations=60_000)
OWN = {s.strategy: s for s in (RAND_1, L_SHADE)}
OF_EACH = {name: OWN.get(name, replace(CMA_ES, strategy=name)) for name in STRATEGIES}
ALL = pytest.mark.parametrize("settings", OF_EACH.values(), ids=OF_EACH)
SHIFT = torch.tensor([0.7, -1.3, 1.9, -0.4], dtype=DOUBLE)
# An orthogonal matrix without zeros.
ROTATION = torch.eye(4, dtype=DOUBLE) - 0.5 * torch.ones(4, 4, dtype=DOUBLE)


def sphere(x: Tensor) -> Tensor:
    return (x * x).sum(-1)


def rosenbrock(x: Tensor) -> Tensor:
    return (100.0 * (x[..., 1:] - x[..., :-1] ** 2) ** 2 + (1.0 - x[..., :-1]) ** 2).sum(-1)


def rastrigin(x: Tensor) -> Tensor:
    return (x * x - 10.0 * torch.cos(2.0 * math.pi * x) + 10.0).sum(-1)


def ackley(x: Tensor) -> Tensor:
    mean_square, mean_cos = (x * x).mean(-1), torch.cos(2.0 * math.pi * x).mean(-1)
    return -20.0 * torch.exp(-0.2 * mean_square.sqrt()) - torch.exp(mean_cos) + 20.0 + math.e


def moved(cost: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    """Shifted and rotated: the optimum goes to SHIFT."""
    return lambda x: cost(((x - SHIFT)[..., None, :] * ROTATION).sum(-1))


HARDEST = moved(rastrigin)


def box(half: float, shape: tuple[int, ...] = (1,), parameters: int = 4) -> tuple[Tensor, Tensor]:
    high = torch.full((*shape, parameters), half, dtype=DOUBLE)
    return -high, high


@ALL
@pytest.mark.parametrize(
    ("cost", "optimum"),
    [
        (sphere, torch.zeros(4)),
        (rosenbrock, torch.ones(4)),
        (rastrigin, torch.zeros(4)),
        (ackley, torch.zeros(4)),
        (moved(sphere), SHIFT),
        (HARDEST, SHIFT),
        (moved(ackley), SHIFT),
    ],
    ids=["sphere", "rosenbrock", "rastrigin", "ackley", "moved-sphere", "moved-rastrigin", "moved-ackley"],
)
def test_finds_the_known_optimum(
    settings: EvolutionSettings, cost: Callable[[Tensor], Tensor], optimum: Tensor
) -> None:
    """Twenty searches each: all of them, but for the hardest, where a neighbouring basin may catch a few.

    A strategy may need a large population against neighbouring basins, or a small one that lasts for more generations.
    """

    def share(population: int) -> float:
        result = evolve(lambda x, _: cost(x), *box(5.0, (20,)), replace(settings, population=population), seeds=11)
        found = ((result.best - optimum).abs() < 2e-5).all(-1) & (result.best_cost < 1e-4)
        return float(found.double().mean())

    least = 0.6 if cost is HARDEST else 1.0
    assert any(share(population) >= least for population in dict.fromkeys((settings.population or LARGE, SMALL)))


@pytest.mark.parametrize(
    "settings",
    [L_SHADE, CMA_ES],
    ids=["l-shade", "cma_es"],
)
def test_finds_an_optimum_in_a_corner_of_the_box(settings: EvolutionSettings) -> None:
    low, high = box(1.0)
    result = evolve(lambda x, _: x.sum(-1), low, high, settings)
    torch.testing.assert_close(result.best, low, rtol=0, atol=1e-3)
    assert ((result.population.nan_to_num() >= -1.0) & (result.population.nan_to_num() <= 1.0)).all()


def test_stop_does_not_depend_on_the_offset_or_the_unit_of_the_cost() -> None:
    settings = replace(RAND_1, parameter_tolerance=1e-3, cost_tolerance=1e-5)
    costs = (sphere, lambda x: sphere(x) + 1e6, lambda x: 2.0**20 * sphere(x))
    results = [evolve(lambda x, _, f=f: f(x), *box(5.0, (4,)), settings) for f in costs]
    assert results[0].reasons() == ["converged"] * 4
    assert len(set(results[0].generations.tolist())) > 1
    for other in results[1:]:
        assert torch.equal(other.generations, results[0].generations)
        assert torch.equal(other.reason, results[0].reason)


def test_each_reason_to_stop_is_given() -> None:
    """Five problems in one batch: one at its target, one flat, one without a finite cost, two out of budget."""
    kind = torch.arange(5)

    def cost(x: Tensor, lanes: Tensor) -> Tensor:
        flat, nothing = torch.zeros_like(x[..., 0]), torch.full_like(x[..., 0], math.nan)
        of = torch.stack((sphere(x), flat + 7.0, nothing, sphere(x) + 1.0, sphere(x) + 2.0))
        return of[kind[lanes], torch.arange(len(lanes))]

    settings = EvolutionSettings("rand/1/bin", population=20, evaluations=1000, patience=30, target=0.5)
    result = evolve(cost, *box(5.0, (5,)), settings)
    assert result.reasons() == ["target", "stalled", "failed", "budget", "budget"]
    assert result.evaluations.tolist()[2:] == [1000, 1000, 1000]
    assert result.generations[1] == 31
    assert result.best_cost[0] <= 0.5 and torch.isinf(result.best_cost[2])
    assert result.converged.tolist() == [True, False, False, False, False]
    assert REASONS[0] == "running"


@ALL
def test_a_contracted_population_whose_costs_differ_has_not_converged(settings: EvolutionSettings) -> None:
    state = strategy_named(settings.strategy).init(*box(1.0, (2,)), settings, torch.tensor([1, 2]))
    cost = torch.linspace(1.0, 2.0, state.cost.shape[-1], dtype=DOUBLE)
    contracted = replace(
        state,
        population=torch.zeros_like(state.population),
        cost=torch.stack([cost, torch.ones_like(cost)]),
        scale=torch.ones(2, dtype=DOUBLE),
        generation=5,
    )
    assert [REASONS[code] for code in stop_reason(contracted, settings).tolist()] == ["running", "converged"]


@ALL
def test_cost_that_is_not_finite_never_wins(settings: EvolutionSettings) -> None:
    """A basin of NaN, infinity and minus infinity lies on the way; the first population has them too."""

    def cost(x: Tensor, lanes: Tensor) -> Tensor:
        value = sphere(x - 1.0)
        value = torch.where(x[..., 0] < 0.0, math.nan, value)
        value = torch.where(x[..., 1] < 0.0, -math.inf, value)
        return torch.where(x[..., 2] < 0.0, math.inf, value)

    seen: list[Search] = []
    result = evolve(cost, *box(5.0, (2,)), settings, on_generation=seen.append)
    assert torch.isinf(seen[0].state.cost).any() and torch.isfinite(seen[0].state.cost[:, 0]).all()
    torch.testing.assert_close(result.best, torch.ones(2, 4, dtype=DOUBLE), rtol=0, atol=1e-4)
    valid = seen[-1].state.population[torch.isfinite(seen[-1].state.cost)]
    assert (valid[:, :3] >= 0.0).all()
    assert not any(torch.isnan(value).any() for search in seen for value in search.state.to_dict().values())


def scaled_costs(targets: Tensor, reached: Tensor | float = 0.0) -> Callable[[Tensor, Tensor], Tensor]:
    """Problem b: Rosenbrock about its own target, less `reached[b]`; problem 2 is NaN everywhere."""
    less = torch.as_tensor(reached, dtype=DOUBLE).expand(len(targets))

    def cost(x: Tensor, lanes: Tensor) -> Tensor:
        value = rosenbrock(x - targets[lanes][:, None] + 1.0) - less[lanes][:, None]
        return torch.where((lanes == 2)[:, None], math.nan, value)

    return cost


@ALL
def test_problem_is_bit_equal_alone_and_among_neighbours_that_finish_or_fail(settings: EvolutionSettings) -> None:
    """However fast the strategy is: problem 0 finishes with its first generation, 1 halfway, 2 fails, the others run
    until their budget is spent.
    """
    settings = replace(settings, evaluations=3000)
    count = 7
    low, high = box(3.0, (count,))
    low = low - torch.arange(count, dtype=DOUBLE)[:, None] / 7
    targets = torch.linspace(-1.0, 1.0, count, dtype=DOUBLE)[:, None].expand(count, 4)
    seeds = torch.arange(100, 100 + count)
    best: list[float] = []
    evolve(
        lambda x, _: scaled_costs(targets)(x, torch.tensor([1])),
        *(low[1], high[1]),
        *(settings, seeds[1]),
        on_generation=lambda search: best.append(float(search.state.cost[0, 0])),
    )
    settings = replace(settings, target=0.0)
    reached = torch.tensor([1e6, best[len(best) // 2] + 1e-9, *[-1.0] * (count - 2)], dtype=DOUBLE)
    together = evolve(scaled_costs(targets, reached), low, high, settings, seeds)
    assert together.reasons()[:3] == ["target", "target", "failed"] and "target" not in together.reasons()[3:]
    assert together.generations[0] == 1 < together.generations[1] < together.generations[2]
    for b in range(count):
        cost = scaled_costs(targets, reached)
        alone = evolve(lambda x, _, b=b, f=cost: f(x, torch.tensor([b])), low[b], high[b], settings, seeds[b])
        for name, value in vars(alone).items():
            assert torch.equal(value.nan_to_num(-7.0), getattr(together, name)[b].nan_to_num(-7.0)), (b, name)


@ALL
def test_large_batch_on_several_threads_changes_no_bit(settings: EvolutionSettings) -> None:
    """Vectorised kernels treat the tails of a tensor apart; where a problem falls must not matter."""
    settings = replace(settings, evaluations=320)
    low, high = box(2.0, (257,))
    seeds, threads = torch.arange(257), torch.get_num_threads()
    torch.set_num_threads(2)
    together = evolve(lambda x, _: rosenbrock(x), low, high, settings, seeds)
    torch.set_num_threads(threads)
    for b in (0, 1, 100, 254, 256):
        alone = evolve(lambda x, _: rosenbrock(x), low[b], high[b], settings, seeds[b])
        assert torch.equal(alone.population.nan_to_num(-7.0), together.population[b].nan_to_num(-7.0))


@ALL
def test_interrupted_search_resumes_bit_for_bit(settings: EvolutionSettings) -> None:
    """Problem 0 finishes with its first generation, 2 fails, the others run until their budget is spent."""
    settings = replace(settings, population=50, evaluations=3000, target=0.0)
    flat = scaled_costs(torch.zeros(6, 4, dtype=DOUBLE), torch.tensor([1e6, *[-1.0] * 5]))
    low, high = box(3.0, (2, 3))
    whole = evolve(flat, low, high, settings, seeds=3)
    held: list[dict[str, Tensor]] = []

    def stop_late(search: Search) -> None:
        held.append(search.to_dict())
        if search.state.generation == 40:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evolve(flat, low, high, settings, seeds=3, on_generation=stop_late)
    for generation in (0, 7, 39):
        search = Search.from_dict({name: value.clone() for name, value in held[generation].items()})
        resumed = evolve(flat, low, high, settings, resume=search)
        for name, value in vars(resumed).items():
            assert torch.equal(value.nan_to_num(-7.0), getattr(whole, name).nan_to_num(-7.0)), (generation, name)
    so_far = snapshot(search)
    assert so_far.best.shape == (2, 3, 4) and so_far.reasons()[:2] == ["target", "running"]


def test_parents_differ_from_each_other_and_are_uniform() -> None:
    size = 7
    u = uniform(stream(torch.arange(30_000), 1), 3 * size).unflatten(-1, (3, size))
    i = torch.arange(size)
    j = draw_other(u[:, 0], size, i)
    k = draw_other(u[:, 1], size, i, j)
    m = draw_other(u[:, 2], size, i, j, k)
    everyone = torch.stack((i.expand_as(j), j, k, m), -1)
    assert (everyone.sort(-1).values.diff(dim=-1) > 0).all()
    assert everyone.min() == 0 and everyone.max() == size - 1
    # Every ordered triple of the six others is equally likely.
    triples = (j * size + k)[:, 0] * size + m[:, 0]
    _, counts = triples.unique(return_counts=True)
    assert len(counts) == 6 * 5 * 4
    assert stats.chisquare(counts.numpy()).pvalue > 0.01


def test_crossover_takes_one_component_surely_and_the_others_at_the_rate() -> None:
    """Of P components, 1 + (P - 1) CR come from the mutant on average; none of the candidates is its parent."""
    settings = EvolutionSettings("rand/1/bin", population=50, rate=0.3)
    low, high = box(1.0, (200,), parameters=6)
    state = init(low, high, settings, torch.arange(200))
    state = tell(state, ask(state, settings), torch.rand(200, 50, dtype=DOUBLE), settings)
    trial = ask(state, settings)
    crossed = trial.candidates != state.population
    share = crossed.sum(-1).double().mean().item()
    assert crossed.any(-1).all()
    assert share == pytest.approx(1.0 + 5 * 0.3, abs=0.02)
    torch.testing.assert_close(crossed.double().mean((0, 1)), torch.full((6,), share / 6).double(), atol=0.02, rtol=0)
    none = ask(state, replace(settings, rate=0.0)).candidates != state.population
    assert (none.sum(-1) == 1).all()


def test_rand_1_mutant_is_a_base_plus_a_scaled_difference_of_members() -> None:
    """With CR = 1 and one problem, each candidate is found among all x_j + F (x_k - x_l). (21)"""
    settings = EvolutionSettings("rand/1/bin", population=5, factor=0.7, rate=1.0)
    low, high = box(1e3, (1,), parameters=2)
    state = init(low, high, settings, torch.tensor([4]))
    state = tell(state, ask(state, settings), torch.arange(5, dtype=DOUBLE)[None], settings)
    state = replace(state, low=state.low * 10, high=state.high * 10)
    x = state.population[0]
    every = x[:, None, None] + 0.7 * (x[None, :, None] - x[None, None, :])
    for i, candidate in enumerate(ask(state, settings).candidates[0]):
        j, k, m = torch.isclose(every, candidate, rtol=1e-12).all(-1).nonzero()[0].tolist()
        assert len({i, j, k, m}) == 4


def test_l_shade_mutant_goes_to_a_p_best_member_with_a_difference_to_members_or_archived_ones() -> None:
    """x_i + F (x_best - x_i + x_1 - x_2) with unit vectors as members, so that each mutant tells what it was made of.
    (Tanabe and Fukunaga 2013, current-to-pbest/1 with archive.)
    """
    size, kept = 20, 10
    settings = replace(L_SHADE, population=size, best_share=0.2, archive_share=kept / size)
    first = init(*box(9.0, (1,), parameters=size + kept), settings, torch.tensor([4]))
    unit = torch.eye(size + kept, dtype=DOUBLE)[None]
    state = replace(
        first,
        population=unit[:, :size],
        cost=torch.arange(size, dtype=DOUBLE)[None],
        archive=unit[:, size:],
        archived=torch.tensor([kept]),
        memory_cr=torch.ones_like(first.memory_cr),
    )
    archived = draws = 0
    for generation in range(1, 60):
        trial = ask(replace(state, generation=generation), settings)
        moves = (trial.candidates[0] - unit[0, :size]) / trial.factor[0, :, None]
        for i in (trial.rate[0] == 1.0).nonzero().flatten().tolist():
            ahead, behind = ((sign * moves[i] > 0.5).nonzero().flatten().tolist() for sign in (1.0, -1.0))
            assert len(behind) < 2 or min(ahead) < 4, "20 % of 20 members, unless x_2 or x_i is the best and cancels it"
            archived, draws = archived + (max(behind, default=0) >= size), draws + 1
    share = kept / (size + kept - 2)
    assert archived / draws == pytest.approx(share, abs=4.0 * (share * (1.0 - share) / draws) ** 0.5)


def test_equal_costs_are_no_successes_in_l_shade() -> None:
    low, high = box(1.0, (1,))
    state = init(low, high, L_SHADE, torch.tensor([1]))
    zeros = torch.zeros_like(state.cost)
    state = tell(state, ask(state, L_SHADE), zeros, L_SHADE)
    after = tell(state, ask(state, L_SHADE), zeros, L_SHADE)
    assert int(after.memory_cell) == 0 and int(after.archived) == 0
    assert bool((after.memory_f == 0.5).all()) and bool((after.memory_cr == 0.5).all())


def test_selection_is_strict_in_the_paper_and_lets_equals_pass_in_l_shade() -> None:
    for settings, passes in ((RAND_1, False), (replace(L_SHADE, archive_share=0.0), True)):
        low, high = box(1.0, (1,))
        state = init(low, high, settings, torch.tensor([1]))
        zeros = torch.zeros_like(state.cost)
        state = tell(state, ask(state, settings), zeros, settings)
        after = tell(state, ask(state, settings), zeros, settings)
        size = after.cost.shape[-1]
        assert torch.equal(after.population, state.population[:, :size]) is not passes


def test_l_shade_memory_moves_and_population_shrinks_to_the_smallest() -> None:
    seen: list[Search] = []
    settings = replace(L_SHADE, evaluations=6000, parameter_tolerance=0.0, patience=10_000)
    evolve(lambda x, _: rosenbrock(x), *box(3.0), settings, on_generation=seen.append)
    sizes = [search.state.cost.shape[-1] for search in seen]
    assert sizes == sorted(sizes, reverse=True) and sizes[-1] == 4
    # L-SHADE (10): linear in the evaluations spent.
    middle = seen[len(seen) // 3]
    assert sizes[len(seen) // 3] == round(80 - 76 * middle.state.evaluations / 6000)
    assert all(s.state.archive.shape[-2] == round(2.6 * s.state.cost.shape[-1]) for s in seen)
    assert (seen[-1].state.memory_f != 0.5).all() and (seen[-1].state.memory_cr != 0.5).all()
    assert seen[40].state.archived > 0


@ALL
def test_first_guess_is_part_of_the_first_population_and_cannot_be_lost(settings: EvolutionSettings) -> None:
    guess = torch.tensor([[1.0, 1.0, 1.0, 1.0], [9.0, 0.0, 0.0, 0.0]], dtype=DOUBLE)
    seen: list[Search] = []
    settings = replace(settings, population=50, patience=1)
    result = evolve(lambda x, _: rosenbrock(x), *box(3.0, (2,)), settings, first_guess=guess, on_generation=seen.append)
    assert torch.equal(result.best, torch.ones(2, 4, dtype=DOUBLE))
    clipped = torch.tensor([3.0, 0.0, 0.0, 0.0], dtype=DOUBLE)
    assert all((member == clipped).all(-1).any() for member in seen[0].state.population)


def test_follows_single_precision() -> None:
    low = -torch.ones(2, 3)
    result = evolve(lambda x, _: sphere(x), low, -low, replace(L_SHADE, parameter_tolerance=1e-3))
    assert result.best.dtype == torch.float32 and result.best.abs().max() < 1e-2


def test_misuse_is_refused_in_words() -> None:
    low, high = box(1.0)
    flat = lambda x, _: sphere(x)  # noqa: E731
    with pytest.raises(ValueError, match=f"expected strategy to be one of {', '.join(STRATEGIES)}, got best/1"):
        EvolutionSettings("best/1")
    with pytest.raises(ValueError, match="expected a population of at least 4, got 3"):
        EvolutionSettings(population=3)
    with pytest.raises(ValueError, match="expected a finite box"):
        evolve(flat, low, high * math.inf)
    with pytest.raises(ValueError, match="expected low and high"):
        evolve(flat, low, high[:, :2])
    with pytest.raises(ValueError, match="expected costs"):
        evolve(lambda x, _: x, low, high)
    with pytest.raises(ValueError, match="expected at most 80 first guesses"):
        evolve(flat, low, high, L_SHADE, first_guess=torch.zeros(81, 4, dtype=DOUBLE))
    with pytest.raises(ValueError, match="expected a budget of at least the population of 80"):
        evolve(flat, low, high, replace(L_SHADE, evaluations=50))


@ALL
def test_search_by_ask_and_tell_alone_is_that_of_evolve(settings: EvolutionSettings) -> None:
    settings = replace(settings, population=20, evaluations=400)
    low, high = box(3.0, (2,))
    seeds = torch.tensor([4, 5])
    strategy = strategy_named(settings.strategy)
    state = strategy.init(low, high, settings, seeds)
    for _ in range(10):
        trial = strategy.ask(state, settings)
        assert ((trial.candidates >= low[:, None]) & (trial.candidates <= high[:, None])).all()
        state = strategy.tell(state, trial, rosenbrock(trial.candidates), settings)
    seen: list[Search] = []
    evolve(lambda x, _: rosenbrock(x), low, high, settings, seeds, on_generation=seen.append)
    assert torch.equal(seen[9].state.population, state.population) and torch.equal(seen[9].state.cost, state.cost)


def test_cma_es_learns_the_scales_and_the_rotation_of_the_cost() -> None:
    """On a rotated ellipsoid the covariance becomes the inverse Hessian, up to a factor (Hansen 2016, section 1.1)."""
    scales = torch.tensor([1.0, 10.0, 100.0, 1000.0], dtype=DOUBLE)
    hessian = ROTATION.T @ torch.diag(scales) @ ROTATION
    seen: list[Search] = []
    settings = EvolutionSettings("cma_es", evaluations=6000, parameter_tolerance=1e-5)
    evolve(lambda x, _: (x @ hessian * x).sum(-1), *box(5.0), settings, 2, on_generation=seen.append)
    assert (seen[-1].state.population[0, 0].abs() < 1e-3).all()
    eigenvalues = torch.linalg.eigvals(seen[-1].state.covariance[0] @ hessian).real  # type: ignore[attr-defined]
    assert eigenvalues.max() / eigenvalues.min() < 10.0


def test_the_state_of_no_strategy_is_refused() -> None:
    with pytest.raises(ValueError, match="expected the state of a search, got cost"):
        state_from_dict({"cost": torch.zeros(1)})


@ALL
def test_a_search_and_its_result_print_in_one_line(settings: EvolutionSettings) -> None:
    low, high = torch.full((3, 2), -1.0, dtype=DOUBLE), torch.full((3, 2), 1.0, dtype=DOUBLE)
    searches: list[Search] = []
    short = replace(settings, evaluations=3 * settings.population)
    result = evolve(lambda x, lanes: sphere(x), low, high, short, on_generation=searches.append)
    running = searches[0]
    assert repr(running).startswith("Search of 3 problems; running: 3 problems, 2 parameters, generation 1, best cost ")
    assert repr(running.state).startswith("3 problems, 2 parameters, generation 1, best cost ")
    assert repr(result).startswith("EvolutionResult: 3 problems, 2 parameters; ")
    assert all(reason in repr(result) for reason in result.reasons())
    assert all("\n" not in repr(x) for x in (running, running.state, result))
