"""Between-run variance of a constant and its confidence interval."""

from __future__ import annotations

import math
import statistics
from dataclasses import replace

import pytest
import torch

from fdi_torch.gap.free_runs.between_runs import RunConstant, between_run_spread


def own(value: float, std: float = 1e-3) -> RunConstant:
    return RunConstant("qL.gain", "run.csv", 0.0, value, std)


def drawn(std: float, error: float, cases: int = 400, runs: int = 6) -> torch.Tensor:
    """Values (cases, runs) that differ between runs, with estimation errors."""
    generator = torch.Generator().manual_seed(3)
    return 1.05 + math.hypot(std, error) * torch.randn(cases, runs, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("error", [1e-4, 5e-3, 0.02])
def test_the_interval_holds_the_true_spread_in_19_of_20_cases(error: float) -> None:
    told = [between_run_spread([own(float(v), error) for v in row], 0.1) for row in drawn(0.01, error)]
    held = sum(t is not None and t.low <= 0.01 <= t.high for t in told)
    assert 0.92 < held / 400 < 0.98


def test_errors_of_estimation_are_no_variance_between_runs() -> None:
    told = [between_run_spread([own(float(v), 0.04) for v in row], 0.1) for row in drawn(0.0, 0.04, runs=12)]
    assert sum(t is not None and t.low == 0.0 for t in told) / 400 > 0.95
    assert sum(t is not None and t.std == 0.0 for t in told) / 400 == pytest.approx(0.56, abs=0.05)  # Q(0) < n - 1


def test_exact_values_have_their_own_mean_and_variance_and_inexact_ones_count_less() -> None:
    values = (1.0, 1.02, 1.05)
    told = between_run_spread([own(v, 1e-9) for v in values], 0.1)
    assert told is not None and told.mean == pytest.approx(statistics.mean(values))
    assert told.std == pytest.approx(statistics.stdev(values))
    assert (told.low, told.high) == pytest.approx([told.std * math.sqrt(2.0 / q) for q in (7.37776, 0.0506356)])
    inexact = between_run_spread([own(1.0), own(1.02), own(1.05, std=0.04)], 0.1)
    assert inexact is not None and 1.01 < inexact.mean < 1.015


def test_recordings_that_do_not_determine_the_constant_do_not_count() -> None:
    told = between_run_spread([own(1.0), own(1.02), own(1.5, std=0.09)], 0.1)
    assert told is not None and told.count == 2 and told.mean == pytest.approx(1.01)
    assert between_run_spread([own(1.0), own(1.5, std=0.09)], 0.1) is None


@pytest.mark.parametrize(("spread", "error"), [(0.5, 0.45), (2.0, 0.45), (1.0, 0.3)])
def test_the_prior_of_the_tolerance_narrows_no_spread(spread: float, error: float) -> None:
    """Each recording's estimate lies between the plant file's value, 1.0, and what its readings say."""
    share = 1.0 - error**2
    values = 1.0 + share * (drawn(spread, error / math.sqrt(share), runs=12) - 1.05)
    told = [
        between_run_spread([replace(own(float(v), error), nominal=1.0, share=share) for v in row], 1.0)
        for row in values
    ]
    held = sum(t is not None and t.low <= spread <= t.high for t in told)
    assert 0.92 < held / 400 < 0.98
    variances = [t.std**2 for t in told if t is not None]
    assert statistics.mean(variances) == pytest.approx(spread**2, rel=0.05)


def test_values_that_are_exact_but_for_rounding_have_a_spread() -> None:
    for k in range(100):
        values = [1.0 + 0.1 * math.sin(12.9898 * k + j) for j in range(4)]
        told = between_run_spread([own(v, 1e-12) for v in values], 1.0)
        assert told is not None and told.std == pytest.approx(statistics.stdev(values))
