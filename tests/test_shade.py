"""The strategy's learning against numbers worked out by hand and distributions known in closed form."""

import math

import torch
from scipy import stats

from fdi_torch.estimate.draws import stream, uniform
from fdi_torch.estimate.shade import (
    TERMINAL,
    draw_factor,
    draw_rate,
    lehmer_mean,
    success_weights,
    update_archive,
    update_memory,
)

DOUBLE = torch.float64
U = uniform(stream(torch.tensor(5), 0), 50_000)


def row(*values: float) -> torch.Tensor:
    return torch.tensor([values], dtype=DOUBLE)


def test_factor_is_cauchy_above_zero_cut_to_one() -> None:
    """Rejection until F > 0 is the Cauchy distribution conditioned on F > 0."""
    memory = 0.15
    factor = draw_factor(torch.full_like(U, memory), U)
    cauchy = stats.cauchy(memory, 0.1)
    below = cauchy.cdf(0.0)
    inside = factor[factor < 1.0]
    assert (factor > 0.0).all() and (factor <= 1.0).all()
    assert abs((factor == 1.0).double().mean().item() - cauchy.sf(1.0) / (1 - below)) < 0.005
    expected = lambda x: (cauchy.cdf(x) - below) / (cauchy.cdf(1.0) - below)  # noqa: E731
    assert stats.kstest(inside.numpy(), expected).pvalue > 0.01


def test_rate_is_normal_cut_to_the_unit_interval_and_zero_from_a_terminal_cell() -> None:
    rate = draw_rate(torch.full_like(U, 0.5), U)
    assert stats.kstest(rate.numpy(), stats.norm(0.5, 0.1).cdf).pvalue > 0.01
    cut = draw_rate(torch.full_like(U, 0.95), U)
    assert abs((cut == 1.0).double().mean().item() - stats.norm.sf(0.5)) < 0.01
    assert (draw_rate(torch.full_like(U, TERMINAL), U) == 0.0).all()


def test_memory_takes_the_weighted_lehmer_mean_and_moves_on() -> None:
    """Gains 1 and 3 of F = 0.4 and 0.8, CR = 0.2 and 0.6: (0.25 a^2 + 0.75 b^2) / (0.25 a + 0.75 b)."""
    memory = torch.full((1, 3), 0.5, dtype=DOUBLE)
    success = torch.tensor([[True, False, True]])
    memory_f, memory_cr, cell = update_memory(
        memory, memory, torch.tensor([1]), row(0.4, 0.9, 0.8), row(0.2, 0.9, 0.6), row(1.0, -5.0, 3.0), success
    )
    assert cell.item() == 2
    torch.testing.assert_close(memory_f, row(0.5, (0.25 * 0.16 + 0.75 * 0.64) / (0.25 * 0.4 + 0.75 * 0.8), 0.5))
    torch.testing.assert_close(memory_cr, row(0.5, (0.25 * 0.04 + 0.75 * 0.36) / (0.25 * 0.2 + 0.75 * 0.6), 0.5))


def test_memory_of_a_problem_without_success_stays() -> None:
    memory = torch.full((2, 3), 0.5, dtype=DOUBLE)
    success = torch.tensor([[False, False], [True, False]])
    both = torch.tensor([[0.9, 0.1], [0.9, 0.1]], dtype=DOUBLE)
    memory_f, _, cell = update_memory(memory, memory, torch.tensor([2, 2]), both, both, both, success)
    assert torch.equal(memory_f[0], memory[0]) and cell.tolist() == [2, 0]
    assert memory_f[1, 2] == 0.9


def test_rate_cell_turns_terminal_when_only_zeros_worked_and_stays_so() -> None:
    memory = torch.full((1, 1), 0.5, dtype=DOUBLE)
    cell, success = torch.tensor([0]), torch.tensor([[True]])
    _, dead, _ = update_memory(memory, memory, cell, row(0.5), row(0.0), row(1.0), success)
    assert dead.item() == TERMINAL
    _, still_dead, _ = update_memory(memory, dead, cell, row(0.5), row(0.7), row(1.0), success)
    assert still_dead.item() == TERMINAL


def test_infinite_gain_counts_as_the_largest_finite_one() -> None:
    gain, success = row(math.inf, 2.0, 1.0, math.nan), torch.tensor([[True, True, True, False]])
    assert torch.equal(success_weights(gain, success), row(1.0, 1.0, 0.5, 0.0))
    assert lehmer_mean(row(0.3), row(0.0)).item() == 0.0


def test_archive_fills_in_order_then_replaces_at_random() -> None:
    parents = torch.arange(6, dtype=DOUBLE).reshape(1, 3, 2)
    archive = torch.full((1, 4, 2), -1.0, dtype=DOUBLE)
    u = torch.tensor([[0.1, 0.1, 0.6]], dtype=DOUBLE)
    archive, filled = update_archive(archive, torch.tensor([1]), parents, torch.tensor([[True, False, True]]), u)
    assert filled.item() == 3
    assert archive[0, :, 0].tolist() == [-1.0, 0.0, 4.0, -1.0]
    # One free place is left; the other two go over places floor(4 * 0.1) and floor(4 * 0.6).
    archive, filled = update_archive(archive, filled, 10 + parents, torch.ones(1, 3, dtype=torch.bool), u)
    assert filled.item() == 4
    assert archive[0, :, 0].tolist() == [12.0, 0.0, 14.0, 10.0]


def test_last_one_stays_where_two_replace_the_same() -> None:
    parents = torch.arange(6, dtype=DOUBLE).reshape(1, 3, 2)
    archive = torch.full((1, 2, 2), -1.0, dtype=DOUBLE)
    u = torch.tensor([[0.9, 0.9, 0.1]], dtype=DOUBLE)
    everyone = torch.ones(1, 3, dtype=torch.bool)
    archive, _ = update_archive(archive, torch.tensor([2]), parents, everyone, u)
    assert archive[0, :, 0].tolist() == [4.0, 2.0]
