"""Signatures of effects against closed forms, and the declared confusions against the measured ones."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import pytest
import torch
from rigs import random_steps, three_tank
from torch import Tensor

from fdi_torch.effects import all_placements, build_network, placements_for
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.operating_range import OperatingRange, operating_range_of
from fdi_torch.simulate.engine import Engine
from fdi_torch.simulate.experiment import lay_out
from fdi_torch.simulate.traced_engine import TracedEngine

STRONG = 0.95


def likeness_of(placements: tuple[Placement, ...]) -> Tensor:
    """|cosines| on the three tanks under random steps over 40 min, coefficients and start levels calibrated away."""
    plant = three_tank((0.3, 0.25, 0.28))
    network = build_network(plant, placements)
    nuisance = [f"{p.name}.discharge_coefficient" for p in plant.pipes] + [f"{t.name}.start_level" for t in plant.tanks]
    wanted = {p.prefix for p in placements}
    space = ParameterSpace(p for p in network.constants if p.name.rpartition(".")[0] in wanted or p.name in nuisance)
    recording = random_steps(plant, 2400.0, sample=20.0)
    engine = TracedEngine(network, space, lay_out(recording, plant.channels(), 20.0))
    reach = operating_range_of(replace(recording, outputs=engine.readings(space.nominal()), mask=None), plant)
    noise = torch.full((3,), 1e-3, dtype=torch.float64)
    directions = signatures(engine, space, placements, plant, reach, noise, nuisance)
    return torch.abs(directions @ directions.T)


def test_what_is_one_thing_has_one_signature_and_what_calibration_absorbs_has_none() -> None:
    names = ("Q1.pump_offset.offset", "T1.evaporation.rate", "OUT2.plugging.size", "h1.sensor_drift.rate")
    same = likeness_of(placements_for(names))
    assert same[0, 1] == pytest.approx(1.0, abs=1e-9)  # a constant flow into T1 is a constant flow into T1
    assert same[2, 2] == 0.0  # plugging from the start is another discharge coefficient
    assert same[0, 3] < 0.8


@pytest.mark.slow
def test_each_effect_names_its_strongest_rival() -> None:
    placements = all_placements(three_tank())
    alike = likeness_of(placements)
    unnamed = set()
    for i, one in enumerate(placements):
        rivals = [j for j, p in enumerate(placements) if p.effect.name != one.effect.name]
        strongest = max(rivals, key=lambda j: float(alike[i, j]))
        rival = placements[strongest].effect
        if alike[i, strongest] > STRONG:
            named = rival.name in one.effect.mistaken_for or one.effect.name in rival.mistaken_for
            unnamed |= set() if named else {(one.prefix, rival.name)}
    assert not unnamed


def signatures(
    engine: Engine,
    space: ParameterSpace,
    placements: Sequence[Placement],
    plant: PlantDescription,
    reach: OperatingRange,
    noise: Tensor,
    nuisance: Iterable[str] = (),
) -> Tensor:
    """Direction of each placement's effect on the whitened readings, (N, S * sensors); zero without any effect.

    A smooth effect's signature is the Jacobian's column of its size at nominal, any other's its largest change over
    its starting points. noise (sensors,): standard deviations. nuisance: names of calibration constants, whose effects
    are projected out.
    """
    readings, jacobian = engine.linearise(space.nominal())
    rows = []
    for placement in placements:
        size = placement.effect.parameters(placement.location, plant)[0].name
        rows.append(jacobian[..., space.index(f"{placement.prefix}.{size}")])
    abrupt = [k for k, placement in enumerate(placements) if not placement.effect.smooth]
    starts = [(k, start) for k in abrupt for start in placements[k].effect.starts(placements[k].location, plant, reach)]
    thetas = [space.vector({f"{placements[k].prefix}.{name}": x for name, x in start.items()}) for k, start in starts]
    changes = engine.readings(torch.stack([*thetas, space.nominal()])) - readings
    for k in abrupt:
        of_starts = [change for (other, _), change in zip(starts, changes, strict=False) if other == k]
        rows[k] = max(of_starts, key=lambda change: float(change.abs().sum()))
    absorbed = [jacobian[..., space.index(name)] for name in nuisance]
    whitened = [torch.flatten(row / noise) for row in (*rows, *absorbed)]
    return _directions(torch.stack(whitened[: len(rows)]), whitened[len(rows) :])


def _directions(rows: Tensor, absorbed: list[Tensor]) -> Tensor:
    """rows with the span of `absorbed` projected out, scaled to unit length; zero where the remainder is negligible."""
    remainder = rows
    if absorbed:
        basis, strength, _ = torch.linalg.svd(torch.stack(absorbed, dim=1), full_matrices=False)
        basis = basis[:, strength > 1e-10 * strength[0]]
        remainder = rows - (rows @ basis) @ basis.T
    length = remainder.norm(dim=1, keepdim=True)
    visible = length > 1e-9 * rows.norm(dim=1, keepdim=True)
    return torch.where(visible, remainder / torch.where(visible, length, 1.0), 0.0)
