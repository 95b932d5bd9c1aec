"""Each rule of the box against the value worked out by hand; what is inside is not touched."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from fdi_torch.estimate.strategy import halfway, reflected

LOW = torch.tensor([0.0, -1.0, 5.0], dtype=torch.float64)
HIGH = torch.tensor([1.0, 1.0, 5.0], dtype=torch.float64)
PARENT = torch.tensor([0.5, 0.0, 5.0], dtype=torch.float64)
OUTSIDE = torch.tensor([[1.25, -1.5, 5.5], [-0.25, 6.5, 4.0]], dtype=torch.float64)
RULES = {
    "reflected": lambda theta: reflected(theta, LOW, HIGH),
    "halfway": lambda theta: halfway(theta, PARENT, LOW, HIGH),
}


@pytest.mark.parametrize(
    ("rule", "expected"),
    [
        ("reflected", [[0.75, -0.5, 5.0], [0.25, -0.5, 5.0]]),
        ("halfway", [[0.75, -0.5, 5.0], [0.25, 0.5, 5.0]]),
    ],
)
def test_rule_brings_back_as_worked_out_by_hand(rule: str, expected: list[list[float]]) -> None:
    assert torch.equal(RULES[rule](OUTSIDE), torch.tensor(expected, dtype=torch.float64))


@pytest.mark.parametrize("rule", RULES.values(), ids=list(RULES))
def test_inside_keeps_every_bit_and_outside_ends_inside(rule: Callable[[Tensor], Tensor]) -> None:
    theta = 3.0 * torch.randn(1000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    repaired = rule(theta)
    within = (theta >= LOW) & (theta <= HIGH)
    assert within.any() and not within.all()
    assert torch.equal(repaired[within], theta[within])
    assert ((repaired >= LOW) & (repaired <= HIGH)).all()
