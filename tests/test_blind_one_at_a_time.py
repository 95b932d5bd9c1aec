"""The baseline names single clear effects and no pairs."""

from __future__ import annotations

import pytest

from benchmarks.blind_rivals.one_at_a_time import one_at_a_time
from tests.test_gap import SMALL, nominal_plant, recorded


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"Q1.pump_gain.factor": 0.8}, [("pump_gain", "Q1")]),
        ({}, []),
        ({"Q1.pump_gain.factor": 0.8, "h3.sensor_bias.bias": 0.01}, [("pump_gain", "Q1")]),
    ],
)
def test_the_winner_is_one_effect_or_none(changed: dict[str, float], named: list[tuple[str, str]]) -> None:
    answer = one_at_a_time(nominal_plant(), recorded(changed, 5, samples=600), SMALL)
    assert [(c["effect"], c["location"]) for c in answer["causes"]] == named
    assert answer["verdict"] == ("named" if named else "no_gap")
    assert answer["posterior"][0]["probability"] == 1.0
