"""Signatures: projection and cosines against closed forms; the library's own word on what is mistaken for what."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from rigs import random_steps, three_tank

from fdi_torch.effects import all_placements, build_network, placements_for
from fdi_torch.effects.signature import signatures
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.reach import reach_of
from fdi_torch.simulate.choose import make_engine
from fdi_torch.simulate.experiment import lay_out

STRONG = 0.95


def likeness_of(placements: tuple[Placement, ...], kind: str) -> torch.Tensor:
    """|cosines| on the three tanks under random steps over 40 min, coefficients and start levels calibrated away."""
    plant = three_tank((0.3, 0.25, 0.28))
    network = build_network(plant, placements)
    nuisance = [f"{p.name}.discharge_coefficient" for p in plant.pipes] + [f"{t.name}.start_level" for t in plant.tanks]
    wanted = {p.prefix for p in placements}
    space = ParameterSpace(p for p in network.constants if p.name.rpartition(".")[0] in wanted or p.name in nuisance)
    recording = random_steps(plant, 2400.0, sample=20.0)
    engine = make_engine(network, space, lay_out(recording, plant.channels(), 20.0), kind)
    reach = reach_of(replace(recording, outputs=engine.readings(space.nominal()), mask=None), plant)
    noise = torch.full((3,), 1e-3, dtype=torch.float64)
    directions = signatures(engine, space, placements, plant, reach, noise, nuisance)
    return torch.abs(directions @ directions.T)


def test_what_is_one_thing_has_one_signature_and_what_calibration_absorbs_has_none() -> None:
    names = ("Q1.pump_offset.offset", "T1.evaporation.rate", "OUT2.plugging.size", "h1.sensor_drift.rate")
    same = likeness_of(placements_for(names), "traced")
    assert same[0, 1] == pytest.approx(1.0, abs=1e-9)  # a constant flow into T1 is a constant flow into T1
    assert same[2, 2] == 0.0  # plugging from the start is another discharge coefficient
    assert same[0, 3] < 0.8


@pytest.mark.slow
def test_each_effect_names_its_strongest_rival() -> None:
    placements = all_placements(three_tank())
    alike = likeness_of(placements, "auto")
    unnamed = set()
    for i, one in enumerate(placements):
        rivals = [j for j, p in enumerate(placements) if p.effect.name != one.effect.name]
        strongest = max(rivals, key=lambda j: float(alike[i, j]))
        rival = placements[strongest].effect
        if alike[i, strongest] > STRONG:
            named = rival.name in one.effect.mistaken_for or one.effect.name in rival.mistaken_for
            unnamed |= set() if named else {(one.prefix, rival.name)}
    assert not unnamed
