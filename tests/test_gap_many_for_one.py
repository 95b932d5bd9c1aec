"""One place that does alone what takes effects elsewhere, or a coincidence of several, has a cause without a name."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from fdi_torch.gap import diagnose as module
from fdi_torch.gap.diagnose import Settings, _unnamed, diagnose
from fdi_torch.gap.where.suspects import Suspect
from tests.test_gap import believed, recorded

LIBRARY = ("pump_gain", "pump_saturation", "coefficient_drift", "unmetered_flow", "leak", "flow_exponent")
DRAW, DRIFT, GAIN, LEAK = ("unmetered_flow", "T2"), ("coefficient_drift", "P32"), ("pump_gain", "Q2"), ("leak", "T2")
BIAS = ("sensor_drift", "h3")


@pytest.mark.parametrize(
    ("causes", "alone", "behind", "tied", "nameless"),
    [
        ({GAIN, LEAK}, 0.0, 9.0, (), False),  # two effects are two causes
        ({DRAW, LEAK}, 0.0, 9.0, (DRAW, LEAK), True),  # one, where each has a moment of its own
        ({DRAW, LEAK}, 5e3, 9.0, (DRAW, LEAK), False),  # unless one place does not do as well
        ({DRAW, DRIFT}, 0.0, 9.0, (DRAW, DRIFT), False),  # or they have no tank in common
        ({DRIFT, BIAS}, 0.0, 9.0, (DRIFT, BIAS), True),  # or the place is another one
        ({GAIN, DRIFT}, 300.0, 9.0, (), False),  # two at places that come as near to it each alone
        ({GAIN, DRIFT}, 300.0, 900.0, (), True),  # and at places that alone do not
        ({GAIN, DRIFT}, 5e3, 900.0, (), False),
    ],
)
def test_one_place_for_many(
    causes: set[tuple[str, str]],
    alone: float,
    behind: float,
    tied: tuple[tuple[str, str], ...],
    nameless: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    named = SimpleNamespace(key=frozenset(causes), open=20.0)
    singles = [SimpleNamespace(key=frozenset({c}), open=9e3) for c in causes]
    monkeypatch.setattr(module, "left_open", lambda fitter, fit: fit.open)
    monkeypatch.setattr(module, "whole_gap", lambda fitter, found: 4e4)
    monkeypatch.setattr(module, "tied", lambda fit: list(tied))
    found: Any = SimpleNamespace(fits=[named, *singles])
    places = [Suspect("T2", alone, 0.0), *(Suspect(p, 9e3, -behind) for p in ("Q2", "P32", "h3"))]
    fit: Any = named
    fitter: Any = SimpleNamespace(subject=SimpleNamespace(plant=believed()))
    assert _unnamed(fitter, fit, found, places) is nameless


def test_a_pump_whose_supply_runs_low_is_no_drift_of_the_outlet() -> None:
    """It delivers less the more it has pumped: the drift of a pipe beside a gain comes near, but neither is there."""
    told = recorded({}, 34, samples=1500)
    assert told.inputs is not None
    pumped = torch.cumsum(told.inputs[:, 1], dim=0)
    share = torch.sqrt(1.0 - 0.35 * pumped / pumped[-1])
    spent = torch.stack([told.inputs[:, 0], told.inputs[:, 1] * share], dim=1)
    real = recorded({}, 34, samples=1500, std=5e-4, inputs=spent)
    answer = diagnose(believed(), replace(real, inputs=told.inputs), settings=Settings(LIBRARY))
    assert answer.verdict == "unknown" and answer.where[0][0] == "Q2"


def test_two_changes_in_time_at_two_places_are_named() -> None:
    truth = {"T1.unmetered_flow.flow": -8e-6, "T1.unmetered_flow.begin": 300.0, "T1.unmetered_flow.duration": 350.0}
    truth |= {"P32.coefficient_drift.rate": -1.5e-4}
    answer = diagnose(believed(), recorded(truth, 32), settings=Settings(LIBRARY))
    assert answer.verdict == "named"
    assert {(c.effect, c.location) for c in answer.causes} == {("unmetered_flow", "T1"), ("coefficient_drift", "P32")}


def test_a_leak_that_grows_is_named() -> None:
    truth = {"T1.leak.size": 0.3, "T1.leak.onset": 250.0, "T1.leak.ramp": 600.0}
    answer = diagnose(believed(), recorded(truth, 33), settings=Settings(LIBRARY))
    assert answer.verdict == "named"
    (leak,) = answer.causes
    assert (leak.effect, leak.location) == ("leak", "T1")
    assert leak.parameters["onset"].value == pytest.approx(250.0, abs=5.0 * leak.parameters["onset"].std)
    assert leak.parameters["ramp"].value == pytest.approx(600.0, abs=5.0 * leak.parameters["ramp"].std)
