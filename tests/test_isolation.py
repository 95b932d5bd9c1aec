"""What a set of several faults has to earn, and what a fit is worth whose laws are not quite the plant's."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from fdi_torch.monitor.hypothesis import Finding, Hypothesis
from fdi_torch.monitor.isolation import doubted, needless, searched

READINGS = 600


def found(columns: tuple[int, ...], score: float, misfit: float, gone: tuple[int, ...] = ()) -> Finding:
    value = torch.tensor([0.3, 0.2, 0.1], dtype=torch.float64)
    hypothesis = Hypothesis(columns, gone=gone)
    return Finding(hypothesis, value, torch.full_like(value, 0.02), 100.0, 1.5, score, misfit, READINGS)


def test_a_set_of_several_is_one_of_many_and_pays_for_the_choice() -> None:
    assert searched(found((0,), -50.0, 300.0), 6).score == -50.0
    pair = searched(found((0, 1), -50.0, 300.0), 6)
    assert pair.score == pytest.approx(-50.0 + 2.0 * math.log(15 / 6)), "15 pairs among 6 faults"
    assert searched(found((0, 1), -50.0, 300.0, gone=(1,)), 6).score == -50.0, "what goes away was not chosen"


def test_where_nothing_fits_all_standard_errors_and_differences_count_by_what_is_left() -> None:
    """Four times the squares that noise has: errors are twice as large, evidence is a quarter."""
    base = 4000.0
    near, far = found((0,), 2.0 * (1200.0 - base) + 10.0, 1200.0), found((1,), 2.0 * (1300.0 - base) + 10.0, 1300.0)
    first, second = doubted([far, near], base)
    assert (first.hypothesis.columns, second.hypothesis.columns) == ((0,), (1,))
    assert first.std.tolist() == pytest.approx([0.04] * 3) and first.onset_std == pytest.approx(3.0)
    assert second.score - first.score == pytest.approx((far.score - near.score) / 4.0)
    fitting = replace(near, misfit=300.0)
    assert doubted([far, fitting], base)[0].std.tolist() == [0.02] * 3, "where one fits, nothing is doubted"


def test_a_fault_of_several_that_is_what_was_believed_is_needless() -> None:
    believed = torch.tensor([0.0, 0.17, 0.0], dtype=torch.float64)
    assert needless(found((0, 1), -50.0, 300.0), believed), "0.2 is 0.17, to 1.5 standard errors"
    assert not needless(found((0, 2), -50.0, 300.0), believed)
    assert not needless(found((1,), -50.0, 300.0), believed), "alone it is all there is"
