"""Between-run variance of a constant and its confidence interval."""

from __future__ import annotations

import pytest
import torch

from fdi_torch.gap.free_runs.between_runs import RunConstant, between_run_spread


def own(value: float, std: float = 1e-3) -> RunConstant:
    return RunConstant("qL.gain", "run.csv", 0.0, value, std)


def test_the_interval_holds_the_true_spread_in_19_of_20_cases() -> None:
    draws = 1.05 + 0.01 * torch.randn(400, 6, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    told = [between_run_spread([own(float(v)) for v in row], 0.1) for row in draws]
    held = sum(t is not None and t.low < 0.01 < t.high for t in told)
    assert 0.92 < held / 400 < 0.98


def test_recordings_that_do_not_determine_the_constant_do_not_count() -> None:
    told = between_run_spread([own(1.0), own(1.02), own(1.5, std=0.09)], 0.1)
    assert told is not None and told.count == 2 and told.mean == pytest.approx(1.01)
    assert between_run_spread([own(1.0), own(1.5, std=0.09)], 0.1) is None
