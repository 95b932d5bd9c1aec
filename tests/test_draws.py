"""The counting generator: known answers, uniformity, independence of streams, and equality with itself in any batch."""

import pytest
import torch
from scipy import stats

from fdi_torch.estimate.draws import mix, problem_seeds, stream, uniform

SEEDS = torch.arange(64)


def test_hash_gives_the_published_words_of_splitmix64() -> None:
    """First three outputs of the reference C program for the seed 1234567."""
    golden = 0x9E3779B97F4A7C15 - 2**64
    words = mix(1234567 + torch.arange(1, 4) * golden)
    unsigned = [int(word) % 2**64 for word in words]
    assert unsigned == [6457827717110365317, 3203168211198807973, 9817491932198370423]


def test_draws_are_uniform_within_streams_and_across_them() -> None:
    u = uniform(stream(SEEDS, 3), 4001)
    assert u.min() > 0.0 and u.max() < 1.0
    assert stats.kstest(u.flatten().numpy(), "uniform").pvalue > 0.01
    assert stats.kstest(u[7].numpy(), "uniform").pvalue > 0.01
    first_draw = uniform(stream(torch.arange(20_000), 3), 1)[:, 0]
    assert stats.kstest(first_draw.numpy(), "uniform").pvalue > 0.01


def test_pairs_of_draws_fill_the_square_evenly() -> None:
    """Chi-square on a 16 x 16 grid, for successive draws, neighbouring seeds and neighbouring generations."""
    u = uniform(stream(SEEDS, 0), 4000)
    later = uniform(stream(SEEDS, 1), 4000)
    for first, second in ((u[:, :-1], u[:, 1:]), (u[:-1], u[1:]), (u, later)):
        cell = (first * 16).long() * 16 + (second * 16).long()
        counts = torch.bincount(cell.flatten(), minlength=256)
        assert stats.chisquare(counts.numpy()).pvalue > 0.01


def test_streams_do_not_depend_on_the_batch_or_on_the_count() -> None:
    u = uniform(stream(SEEDS.reshape(8, 8), 5, 1), 33)
    for seed in (0, 17, 63):
        assert torch.equal(uniform(stream(SEEDS[seed], 5, 1), 33), u.reshape(64, 33)[seed])
        assert torch.equal(uniform(stream(SEEDS[seed], 5, 1), 12), u.reshape(64, 33)[seed, :12])


def test_problem_seeds_differ_and_take_any_integer() -> None:
    seeds = torch.cat([problem_seeds(seed, (50, 20)).flatten() for seed in (0, 1, -5, 2**65 + 9)])
    assert seeds.unique().numel() == 3000 + 1000
    assert problem_seeds(4).shape == ()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_both_devices_draw_the_same_bits() -> None:
    u = uniform(stream(SEEDS, 2), 1001)
    assert torch.equal(uniform(stream(SEEDS.cuda(), 2), 1001).cpu(), u)
