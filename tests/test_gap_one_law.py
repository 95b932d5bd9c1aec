"""A place has one law of a kind: two forms of it found together are one that the library lacks, or one a little off."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from fdi_torch.gap.diagnose import Settings, _doubted, diagnose
from fdi_torch.gap.library import stacked
from tests.test_gap import believed, recorded

EXPONENT, LAMINAR = ("flow_exponent", "P13"), ("laminar_flow", "P13")


@pytest.mark.parametrize(
    "real",
    [
        {("pump_dead_zone", "Q1"), ("pump_delay", "Q1")},
        {("pump_gain", "Q1"), ("pump_dead_zone", "Q1")},
        {("sensor_gain", "h1"), ("sensor_bias", "h1")},
        {("plugging", "P13"), ("flow_exponent", "P13")},
        {("laminar_flow", "P13"), ("flow_exponent", "P32")},
        {("valve_characteristic", "LM"), ("valve_authority", "LM")},  # its bore by its stem, and what resists beside it
    ],
)
def test_two_causes_of_several_kinds_or_places_are_two(real: set[tuple[str, str]]) -> None:
    assert not stacked(real)


def test_two_forms_of_one_law_at_one_place_are_one_law() -> None:
    assert stacked([LAMINAR, EXPONENT, ("sensor_bias", "h1")]) == {LAMINAR, EXPONENT}


@pytest.mark.parametrize(("left", "top"), [(0.01, {EXPONENT}), (0.1, {EXPONENT, LAMINAR})])
def test_a_law_that_is_a_little_off_is_told_by_its_own_name(left: float, top: set[tuple[str, str]]) -> None:
    gap = 1e5
    fits: list[Any] = [
        SimpleNamespace(key=frozenset({EXPONENT, LAMINAR}), cost=1000.0),
        SimpleNamespace(key=frozenset({EXPONENT}), cost=1000.0 + left * gap),
    ]
    weights = _doubted([1.0, 0.0], fits, gap)
    assert sum(weights) == pytest.approx(1.0)
    assert set(fits[weights.index(max(weights))].key) == top


def test_a_law_between_two_that_have_names_has_none() -> None:
    values = {"P13.laminar_flow.transition_head": 0.1, "P13.flow_exponent.excess": -0.3}
    library = ("laminar_flow", "flow_exponent", "pump_gain", "sensor_bias", "leak")
    answer = diagnose(believed(), recorded(values, 81), settings=Settings(library))
    assert answer.verdict == "unknown" and answer.where[0][0] == "P13"
