"""Names that are suggested for a mistyped one: those that may be meant, and none that is far-fetched."""

from __future__ import annotations

import pytest

from fdi_torch.effects import EFFECTS, effect
from fdi_torch.names import nearest, similar

EFFECT_NAMES = [e.name for e in EFFECTS]
KEYS = ["area", "height", "discharge_coefficient", "start_level", "columns", "simulate", "leak_reference", "max_flow"]


@pytest.mark.parametrize(
    ("name", "known", "meant"),
    [
        ("leek", EFFECT_NAMES, ["leak"]),
        ("leakage", EFFECT_NAMES, ["leak"]),
        ("Pump_Gian", EFFECT_NAMES, ["pump_gain"]),
        ("gain_pump", EFFECT_NAMES, ["pump_gain"]),
        ("clogging", EFFECT_NAMES, ["plugging"]),
        ("stuck", EFFECT_NAMES, ["actuator_stuck", "sensor_stuck"]),
        ("saturation", EFFECT_NAMES, ["pump_saturation", "sensor_saturation"]),
        ("aera", KEYS, ["area"]),
        ("hieght", KEYS, ["height"]),
        ("coefficient", KEYS, ["discharge_coefficient"]),
        ("colum", KEYS, ["columns"]),
        ("T9.area", ["T1.area", "T2.area", "T1.height"], ["T1.area", "T2.area"]),
        ("Z", [], []),
    ],
)
def test_what_may_be_meant(name: str, known: list[str], meant: list[str]) -> None:
    assert similar(name, known) == meant


@pytest.mark.parametrize("name", ["foo", "temperature", "friction", "cavitation", "sensor_freeze", "pump_fault"])
def test_no_effect_is_suggested_for_a_word_that_is_none(name: str) -> None:
    with pytest.raises(ValueError, match=f"expected an effect of the library, got '{name}'; fdi effects lists them"):
        effect(name)


@pytest.mark.parametrize("name", ["colour", "diameter", "volume", "file", "initial", "cd"])
def test_no_key_is_suggested_that_looks_alike_only(name: str) -> None:
    assert nearest(name, KEYS) == ""
