"""The parts below the commands for Python: the network of a plant, and the set-up of a fit, for a plant or its name."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from fdi_torch import effects
from fdi_torch.config.plant_file import AnyPlant, given_plant
from fdi_torch.estimate import fitting
from fdi_torch.estimate.fitting import EngineKind, Fitting, StartLevels
from fdi_torch.jobs.python_functions import AnyRecording, plant_of, recordings_of
from fdi_torch.parameters import Parameter
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.network import TankNetwork
from fdi_torch.recording import Recording


def build_network(plant: AnyPlant, placements: Iterable[Placement] = ()) -> TankNetwork:
    """The network of a plant with its known effects, and with further ones to be estimated.

    A further placement is ignored if the plant already has that effect at that place.
    """
    return effects.build_network(given_plant(plant), placements)


def set_up(
    plant: AnyPlant,
    recordings: AnyRecording | Sequence[AnyRecording],
    parameters: Iterable[str | Parameter],
    start: StartLevels | Sequence[StartLevels] = "free",
    engine: EngineKind = "auto",
) -> Fitting:
    """Set up the fit of `parameters` ('T1.leak', 'T1.leak.size', or a Parameter with its own range) to one or several
    recordings.

    plant, recordings: as of `gap`. A Recording in memory is taken as it is, and the fit is computed on its device; one
    from a file is split into segments with known inputs.
    start: initial levels, one choice for all tanks or a mapping by tank, for all recordings or a sequence with one
    entry per recording. A choice is 'equilibrium' (the level of the plant file, else the equilibrium under the first
    inputs), 'free' (estimated) or a level in m.
    Raises ValueError for an unknown parameter or choice, and for a channel that is not recorded.
    """
    described = plant_of(plant)
    listed: Sequence[Any] = recordings if isinstance(recordings, list | tuple) else [recordings]
    read = [r for each in listed for r in ([each] if isinstance(each, Recording) else recordings_of(each, described))]
    return fitting.set_up(described, read, parameters, start, engine)
