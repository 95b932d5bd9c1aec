"""The parts below the commands for Python: the network of a plant, and the set-up of a fit, for a plant or its name."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import wraps
from typing import Any

from fdi_torch import effects
from fdi_torch.config.plant_file import AnyPlant, chosen_plant, given_plant
from fdi_torch.estimate import fitting
from fdi_torch.estimate.fitting import Fitting
from fdi_torch.jobs.python_functions import AnyRecording, recordings_of
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.network import TankNetwork
from fdi_torch.recording import Recording


def build_network(plant: AnyPlant, placements: Iterable[Placement] = ()) -> TankNetwork:
    """The network of a plant with its known effects, and with further ones to be estimated.

    A further placement is ignored if the plant already has that effect at that place.
    """
    return effects.build_network(given_plant(plant), placements)


@wraps(fitting.set_up)
def set_up(plant: AnyPlant, recordings: AnyRecording | Sequence[AnyRecording], *choices: Any, **named: Any) -> Fitting:
    described = chosen_plant(plant)
    listed: Sequence[Any] = recordings if isinstance(recordings, list | tuple) else [recordings]
    read = [r for each in listed for r in ([each] if isinstance(each, Recording) else recordings_of(each, described))]
    return fitting.set_up(described, read, *choices, **named)
