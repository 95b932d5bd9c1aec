"""Export of a plant as an FMU."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fdi_torch.config.plant_file import AnyPlant, given_plant
from fdi_torch.effects import build_network, place
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.effect import Placement
from fdi_torch.simulate.fmu import write_fmu
from fdi_torch.tables import Table


def export_fmu(plant: AnyPlant, file: str | Path, *, effects: Sequence[str] = ()) -> Table:
    """Write a plant with its effects as an FMU for co-simulation (FMI 2.0), as `fdi export --fmu` does.

    effects: further effects that are absent until a parameter is set, such as "T1.leak". Returns one row per variable
    of the FMU: name, causality, variability, unit (SI) and start value. Raises ValueError for an effect that does not
    exist or has a dead time, BuildError without a C++ compiler.
    """
    variables = write_fmu(build_network(given_plant(plant), [_placement(name) for name in effects]), Path(file))
    columns = ("name", "causality", "variability", "unit", "start")
    return Table(columns, [[getattr(variable, column) for column in columns] for variable in variables])


def _placement(name: str) -> Placement:
    at = ParameterName.of_effect(name)
    if not at.effect:
        raise ValueError(f"expected an effect at a location such as T1.leak, got '{name}'; see fdi effects")
    return place(at.effect, at.place)
