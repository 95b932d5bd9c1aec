"""Names of parameters in their parts."""

from __future__ import annotations

from dataclasses import replace

import pytest
from rigs import three_tank

from fdi_torch.effects import build_network, effect
from fdi_torch.parameters import ParameterName, by_prefix, common_name, name_in_recording
from fdi_torch.plant.description import PlacedEffect, Sensor, with_tolerances
from fdi_torch.plant.effect import Placement


@pytest.mark.parametrize(
    ("text", "parts", "prefix", "at_place", "constant"),
    [
        ("T1.area", ("T1", "", "area", 0), "T1", "area", True),
        ("T1.leak.size", ("T1", "leak", "size", 0), "T1.leak", "leak.size", False),
        ("T1-T2.cross_flow.size", ("T1-T2", "cross_flow", "size", 0), "T1-T2.cross_flow", "cross_flow.size", False),
        ("T1.start_level@2", ("T1", "", "start_level", 2), "T1", "start_level", True),
        ("gravity", ("", "", "gravity", 0), "", "gravity", False),
        ("T@1.start_level@2", ("T@1", "", "start_level", 2), "T@1", "start_level", True),
        ("me@home.size", ("me@home", "", "size", 0), "me@home", "size", True),
    ],
)
def test_a_name_has_parts_and_its_text_is_kept(
    text: str, parts: tuple[str, str, str, int], prefix: str, at_place: str, constant: bool
) -> None:
    name = ParameterName.parse(text)
    assert name == ParameterName(*parts)
    assert (str(name), name.prefix, name.at_place, name.is_constant) == (text, prefix, at_place, constant)


def test_an_effect_may_be_named_without_its_field() -> None:
    assert ParameterName.of_effect("T1.leak") == ParameterName("T1", "leak", "")
    assert ParameterName.of_effect("T1.leak.size") == ParameterName("T1", "leak", "size")
    assert ParameterName.of_effect("leak").effect == ""


def test_names_of_recordings() -> None:
    assert [name_in_recording("L.start_level", k) for k in (0, 1)] == ["L.start_level", "L.start_level@1"]
    assert common_name("L.start_level@1") == common_name("L.start_level") == "L.start_level"


def test_placements_form_the_names_that_group_by_prefix() -> None:
    placement = Placement(effect("leak"), "T1")
    assert placement.full_name("size") == PlacedEffect("leak", "T1").full_name("size") == "T1.leak.size"
    grouped = by_prefix({"T1.leak.size": 1, "T1.area": 2, "T1.leak.height": 3, "gravity": 4})
    assert grouped == {"T1.leak": {"size": 1, "height": 3}, "T1": {"area": 2}, "": {"gravity": 4}}


def test_tolerances_of_constants_are_relative_and_those_of_offsets_and_effects_absolute() -> None:
    plant = replace(
        three_tank(),
        sensors=(Sensor("h1", "T1", unit="V", gain=-20.0, offset=9.0),),
        tolerances={"T1.area": 0.01, "h1.gain": 0.02, "h1.offset": 0.03, "Q1.pump_lag.time_constant": 0.5},
    )
    constants = build_network(plant, [Placement(effect("pump_lag"), "Q1")]).constants
    std = {name: constants[name].std for name in plant.tolerances}
    assert std == pytest.approx(
        {"T1.area": 0.01 * 160e-4, "h1.gain": 0.02 * 20.0, "h1.offset": 0.03, "Q1.pump_lag.time_constant": 0.5}
    )


def test_tolerances_are_kept_by_name() -> None:
    tolerances = {"T1.area": 0.01, "Q1.gain": 0.02, "Q1.pump_lag.time_constant": 0.5}
    plant = replace(three_tank(), tolerances=tolerances, varying=("Q1.gain", "T1.area"))
    kept = with_tolerances(plant, lambda name: name.place != "Q1")
    assert (kept.tolerances, kept.varying) == ({"T1.area": 0.01}, ("T1.area",))
