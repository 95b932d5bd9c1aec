"""What an effect does to the readings, as a direction: computed at an experiment, never written by hand.

Two effects whose signatures point the same way explain the same data at this excitation.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.reach import Reach
from fdi_torch.simulate.engine import Engine


def signatures(
    engine: Engine,
    space: ParameterSpace,
    placements: Sequence[Placement],
    plant: PlantDescription,
    reach: Reach,
    noise: Tensor,
    nuisance: Iterable[str] = (),
) -> Tensor:
    """One unit vector for each placement, (N, S * sensors); zero where nothing shows.

    space: the engine's; it holds all parameters of the placements. noise (sensors,): what a reading is measured
    against. nuisance: names of calibration constants; what they can do to the readings is projected out. A smooth
    effect's signature is the Jacobian's column of its size at nominal, any other's its largest change over its starts.
    """
    nominal = space.nominal()
    readings, jacobian = engine.linearise(nominal)
    rows = []
    for placement in placements:
        size = placement.effect.parameters(placement.location, plant)[0].name
        if placement.effect.smooth:
            rows.append(jacobian[..., space.index(f"{placement.prefix}.{size}")])
        else:
            rows.append(_largest_change(engine, space, placement, plant, reach, readings))
    absorbed = [jacobian[..., space.index(name)] for name in nuisance]
    whitened = [torch.flatten(row / noise) for row in (*rows, *absorbed)]
    return _directions(torch.stack(whitened[: len(rows)]), whitened[len(rows) :])


def _largest_change(
    engine: Engine,
    space: ParameterSpace,
    placement: Placement,
    plant: PlantDescription,
    reach: Reach,
    readings: Tensor,
) -> Tensor:
    starts = placement.effect.starts(placement.location, plant, reach)
    named = [{f"{placement.prefix}.{name}": value for name, value in start.items()} for start in starts]
    changes = engine.readings(torch.stack([space.vector(start) for start in named])) - readings
    return changes[int(changes.abs().flatten(1).sum(1).argmax())]


def _directions(rows: Tensor, absorbed: list[Tensor]) -> Tensor:
    """rows less what the absorbed vectors span, scaled to length 1; zero where (nearly) nothing remains."""
    rest = rows
    if absorbed:
        basis, strength, _ = torch.linalg.svd(torch.stack(absorbed, dim=1), full_matrices=False)
        basis = basis[:, strength > 1e-10 * strength[0]]
        rest = rows - (rows @ basis) @ basis.T
    length = rest.norm(dim=1, keepdim=True)
    there = length > 1e-9 * rows.norm(dim=1, keepdim=True)
    return torch.where(there, rest / torch.where(there, length, 1.0), 0.0)
