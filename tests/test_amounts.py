"""Faults and estimates in words: the same on terminal, page and log, with the digits that the error justifies."""

from __future__ import annotations

import math

import pytest

from fdi_torch import Plant, Pump, Sensor, Tank, Transfer
from fdi_torch.amounts import (
    end_words,
    estimate_words,
    faults_in_words,
    interval_words,
    parameter_words,
    rounded,
    sized_words,
    with_error,
)
from fdi_torch.effects import units_for_display
from fdi_torch.monitor.events import Event, Explanation, Size, headline
from fdi_torch.quantities import displayed_in
from fdi_torch.tables import Table


def size(name: str, value: float, std: float, unit: str = "1") -> Size:
    return Size(name, value, std, unit, estimate_words(name, unit, value, std))


LEAK = Explanation(0.57, (size("A.leak.size", 0.20241, 0.00163),))
OFFSET = Explanation(0.43, (size("Q.pump_offset.offset", -17.87e-6, 0.143e-6, "m^3/s"),))


def test_names_of_parameters_in_words() -> None:
    assert parameter_words("T1.leak.size") == "leak at T1"
    assert parameter_words("P13.laminar_flow.transition_head") == "laminar flow at P13"
    assert parameter_words("T1.area") == "area of T1" and parameter_words("gravity") == "gravity"


def test_faults_of_one_kind_are_listed_together() -> None:
    names = ["A.leak.size", "B.leak.size", "Q.pump_gain.factor", "A.sensor_bias.bias"]
    assert faults_in_words(names) == ["leak at A and B", "pump gain at Q", "sensor bias at A"]


def test_a_fault_of_a_transfer_is_not_called_one_of_a_pump() -> None:
    tanks, pumps = [Tank("A", area="200 cm^2", height="60 cm")], [Pump("Q", "A", max_flow="6 l/min")]
    transfers = [Transfer("back", "A", "outside", max_flow="2 l/min")]
    plant = Plant(tanks, pumps=pumps, transfers=transfers, sensors=[Sensor("hA", "A")])
    with displayed_in(units_for_display(plant)):
        assert parameter_words("back.pump_gain.factor") == "transfer gain at back"
        assert parameter_words("back.actuator_stuck.onset") == "actuator stuck at back"
        assert parameter_words("Q.pump_gain.factor") == "pump gain at Q"


def test_a_monitor_says_faults_as_pages_do() -> None:
    assert headline([LEAK]) == "leak at A (size 0.2024 ± 0.0016)"
    with displayed_in({"m^3/s": "l/min"}):
        offset = Explanation(0.43, (size("Q.pump_offset.offset", -17.87e-6, 0.143e-6, "m^3/s"),))
        assert headline([LEAK, offset]) == (
            "leak at A (size 0.2024 ± 0.0016), 57 %, or pump offset at Q (-1.0722 ± 0.0086 l/min), 43 %"
        )


def test_parameters_of_one_effect_and_several_effects_stand_together() -> None:
    wave = (size("Q.pulsation.amplitude", 2.0e-6, 0.1e-6, "m^3/s"), size("Q.pulsation.phase", 0.31, 0.02))
    assert Explanation(1.0, (*wave, *LEAK.sizes)).text == (
        "pulsation at Q (2.00 ± 0.10 cm^3/s, phase 0.310 ± 0.020) and leak at A (size 0.2024 ± 0.0016)"
    )
    both = size("A.leak.size", 0.0, 0.0), size("B.leak.size", 0.2, 0.01)
    assert Explanation(1.0, both[:1], ended=("A.leak.size",)).text == "leak at A back to nominal"
    mixed = Explanation(0.4, both, ended=("A.leak.size",))
    assert mixed.text == "leak at B (size 0.200 ± 0.010), with leak at A back to nominal"
    assert mixed.causes == "leak at B, with leak at A back to nominal"
    assert Event(1.0, "explained", "", explanations=(mixed,)).masses == {"B.leak.size": 0.4}
    assert Explanation(1.0, ()).text == "chance" and sized_words("A.leak.size", []) == "leak at A"


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (0.3, 0.002, "0.3000 ± 0.0020"),
        (1234.5, 123.4, "1234 ± 123"),
        (2.44e-7, 2.4e-8, "(2.44 ± 0.24)·10⁻⁷"),
        (-1.07218, 0.0086, "-1.0722 ± 0.0086"),
        (0.3, 0.0, "0.3"),
        (0.3, float("inf"), "not determined"),
        (float("nan"), 1.0, "unknown"),
    ],
)
def test_an_error_has_two_digits_and_the_value_its_decimals(value: float, std: float, text: str) -> None:
    assert with_error(value, std) == text


def test_an_estimate_at_an_end_of_its_range_has_a_limit_on_one_side() -> None:
    """Half of a normal distribution has 95 % of its probability within 1.96 standard deviations."""
    assert with_error(0.0, 0.026, "low") == "below 0.051" and with_error(1.0, 0.026, "high") == "above 0.949"
    assert with_error(0.0, float("inf"), "low") == "not determined" and with_error(0.0, 0.0, "low") == "0"
    assert interval_words(0.0, 0.026, 0.0, 1.0, "low") == "below 0.051"
    assert end_words("B.leak.size", "low") == "B.leak.size lies at the low end of its range"


def test_numbers_of_a_table_have_the_digits_of_their_error() -> None:
    assert [rounded(v, 0.004) for v in (0.0271818, 0.004, 0.0)] == ["0.0272", "0.0040", "0.0000"]
    assert rounded(0.451569442664, 2.2e-20) == "0.451569"  # a fit that has not converged
    assert rounded(1234.56, 123.0) == "1235" and rounded(2.4417e-9, 2.4e-10) == "2.44e-09"
    assert rounded(2.4e-10, 2.4e-10) == "2.4e-10" and rounded(0.3, 0.0) == "0.3" and rounded(0.3, float("inf")) == "0.3"


def test_probabilities_in_a_table_have_three_digits() -> None:
    shown = Table(("explanation", "probability"), [("leak at A", 0.697017)]).cells()
    assert shown == [["leak at A", "69.7 %"]]


@pytest.mark.parametrize(
    ("value", "std", "low", "high", "text"),
    [
        (0.5, 0.1, 0.0, 1.0, "0.30 … 0.70"),
        (0.1, 0.1, 0.0, 1.0, "below 0.30"),  # whether or not the estimate lies at the end
        (0.9, 0.1, 0.0, 1.0, "above 0.70"),
        (-0.3, 1.7, -1.0, 1.0, "-1.0 … 1.0"),  # the readings set no limit
        (0.1, 0.1, -math.inf, math.inf, "-0.10 … 0.30"),
        (0.1, math.inf, 0.0, 1.0, "–"),
    ],
)
def test_an_interval_lies_within_the_range_of_its_parameter(
    value: float, std: float, low: float, high: float, text: str
) -> None:
    assert interval_words(value, std, low, high) == text
