"""Tanks named as on a drawing, T-1 to T-3: a pair of them has more than one hyphen in its name."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from fdi_torch.config.plant_file import load_plant
from fdi_torch.effects import effect
from fdi_torch.gap.diagnose import Settings, diagnose
from fdi_torch.gap.library import library_of, tanks_of
from fdi_torch.monitor.structural_analysis import structure_of
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Placement
from tests.test_gap import recorded

PLANTS = Path(__file__).parents[1] / "fdi_torch" / "configs" / "plants"


@pytest.fixture
def plant(tmp_path: Path) -> PlantDescription:
    text = re.sub(r"\bT([123])\b", r"T-\1", (PLANTS / "three_tank.yaml").read_text(encoding="utf-8"))
    path = tmp_path / "rig.yaml"
    path.write_text(text, encoding="utf-8")
    return load_plant(path)


def test_a_pair_of_tanks_is_found_in_either_order(plant: PlantDescription) -> None:
    assert [p.location for p in library_of(plant, ("cross_flow@T-3-T-1",))] == ["T-1-T-3"]
    assert tanks_of("T-1-T-3", plant) == ("T-1", "T-3")
    assert tanks_of("T-1", plant) == ("T-1",)


def test_a_fault_violates_the_balances_of_its_tanks(plant: PlantDescription) -> None:
    faults = structure_of(plant, [Placement(effect("leak"), "T-1"), Placement(effect("cross_flow"), "T-1-T-3")]).faults
    assert faults == {
        "T-1.leak": frozenset({"balance T-1"}),
        "T-1-T-3.cross_flow": frozenset({"balance T-1", "balance T-3"}),
    }


@pytest.mark.slow
def test_a_flow_between_two_tanks_is_named(plant: PlantDescription) -> None:
    answer = diagnose(plant, recorded({"T1-T2.cross_flow.size": 0.3}, 21), settings=Settings(most=2))
    assert [(c.effect, c.location) for c in answer.causes] == [("cross_flow", "T-1-T-2")]
