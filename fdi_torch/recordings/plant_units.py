"""Units that are wrong for a whole kind of number: all areas, all flows, all levels, or the area of a tank.

A correction divides these numbers by the ratio of two units. The volume balance of a tank (`volume_balance.py`)
supports it if it excludes the plant as it is, accepts the corrected one, and excludes the same correction by a ratio
ten times larger or smaller; it contradicts what it excludes. A correction is reported if it leads to a usual unit, and
if more tanks support it than contradict it. Only a tank with a metered flow has an absolute scale; most of these
must exclude the plant as it is. The area of one tank is reported only if no other tank excludes the plant.

An unusual plant does not pass for a wrong unit: a leak or a plugged pipe changes a coefficient of the balance by some
factor, but not by one that is within its standard error of the ratio of two units. What has one channel alone is left
to `gap.preprocess.channel_assignment`, where effects of the plant compete.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import torch
from torch import Tensor

from fdi_torch.parameters import display_unit, unit_factor
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording
from fdi_torch.recordings.volume_balance import Volumes, volumes_along
from fdi_torch.units import same_kind

UNITS = {
    "m": ("mm", "cm", "dm", "m"),
    "m^2": ("mm^2", "cm^2", "dm^2", "m^2"),
    "m^3/s": ("cm^3/s", "l/h", "l/min", "l/s", "m^3/h", "m^3/s"),
}
"""The usual units of each kind of number."""


@dataclass(frozen=True)
class Correction:
    """names: what is divided. kind: its SI unit. written: its unit. fed: tanks with a metered flow whose balance it
    changes. tanks: all tanks whose balance it changes. volumes: of the plant after division by a ratio."""

    names: str
    kind: str
    written: str
    fed: Sequence[int]
    tanks: Sequence[int]
    volumes: Callable[[float], Volumes]

    def likeliest(self, excluded: Collection[int]) -> tuple[int, float] | None:
        """How many more tanks support the best ratio than contradict it, and that ratio; None if there is none.

        excluded: the tanks whose balance excludes the plant as it is.
        """
        if 2 * sum(tank in excluded for tank in self.fed) <= len(self.fed):
            return None
        corrected = {ratio: self.volumes(ratio) for ratio in _ratios(self.kind)}
        votes = dict.fromkeys(corrected, 0)
        for tank in self.tanks:
            accepted = [ratio for ratio, of in corrected.items() if of.distance(tank) <= 1.0]
            accepted += [] if tank in excluded else [1.0]
            determined = bool(accepted) and max(accepted) < 9.9 * min(accepted)
            for ratio in votes:
                votes[ratio] += int(determined) if ratio in accepted else -1
        best = max((ratio for ratio in votes if self.meant(ratio)), key=votes.__getitem__, default=1.0)
        return (votes[best], best) if votes.get(best, 0) > 0 else None

    def meant(self, ratio: float) -> str:
        """The unit in which the numbers are right; '' if it is none of the usual ones."""
        written = unit_factor(self.written, self.kind)
        close = (u for u in UNITS[self.kind] if math.isclose(written, ratio * unit_factor(u, self.kind), rel_tol=1e-6))
        return next(close, "")

    def text(self, ratio: float) -> str:
        what_to_do = f"write {self.meant(ratio)} in place of {self.written}"
        size = f"{float(f'{max(ratio, 1.0 / ratio):.3g}'):.7g} times too {'large' if ratio > 1.0 else 'small'}"
        return f"{self.names} {size} ({what_to_do})"


def wrong_units(plant: PlantDescription, recording: Recording) -> str:
    """What is wrong by the ratio of two units and what to write, in one sentence; '' if the balance holds or is off by
    something else."""
    volumes = volumes_along(plant, recording)
    distances = {i: volumes.distance(i) for i in range(len(plant.tanks))}
    tanks = [i for i, distance in distances.items() if not math.isnan(distance)]
    fed = [i for i in tanks if bool((volumes.metered[0, :, i].nan_to_num() != 0.0).any())]
    excluded = {i for i in tanks if distances[i] > 1.0}
    alone = [i for i in fed if excluded == {i}]
    of_all, of_a_tank = _of_all(plant, recording, volumes, fed, tanks), _of_a_tank(plant, volumes, alone)
    for corrections in (of_all, of_a_tank) if excluded.intersection(fed) else ():
        found = [(*best, correction) for correction in corrections if (best := correction.likeliest(excluded))]
        most = max((votes for votes, _, _ in found), default=0)
        likely = [(correction, ratio) for votes, ratio, correction in found if votes == most]
        if likely:
            texts = [correction.text(ratio) for correction, ratio in likely]
            return f"units: by the volume balance of the tanks, {' or '.join(texts)}"
    return ""


def expect_right_units(plant: PlantDescription, recording: Recording) -> None:
    """Raises ValueError if units are wrong, unless the recording is trusted."""
    if not recording.trusted and (wrong := wrong_units(plant, recording)):
        raise ValueError(refusal(recording, wrong))


def refusal(recording: Recording, problem: str) -> str:
    """Why a recording is refused, and what to do if it is right after all."""
    return f"{recording.source}: {problem}; if the recording is right, state trusted: true beside the file"


def _ratios(kind: str) -> list[float]:
    """The ratios of two units, of a decade or more."""
    ratios = {unit_factor(a, kind) / unit_factor(b, kind) for a, b in permutations(UNITS[kind], 2)}
    return sorted({float(f"{ratio:.9g}") for ratio in ratios if not 0.101 < ratio < 9.9})


def _of_all(
    plant: PlantDescription, recording: Recording, as_is: Volumes, fed: Sequence[int], tanks: Sequence[int]
) -> Iterator[Correction]:
    """Corrections of all numbers of a kind."""
    area = display_unit("m^2")[0]
    if len(plant.tanks) > 1:
        yield Correction("the areas of all tanks are", "m^2", area, fed, tanks, lambda r: _smaller(as_is, r, 1.0))
    if plant.pipes:
        yield Correction("the areas of all pipes are", "m^2", area, fed, tanks, lambda r: _smaller(as_is, 1.0, r))
        yield Correction(
            "the areas of all tanks and pipes are", "m^2", area, fed, tanks, lambda r: _smaller(as_is, r, r)
        )
    channels = [component.channel for component in plant.metered_flows()]
    columns = [recording.input_names.index(channel) for channel in channels]

    def slower(ratio: float) -> Volumes:
        inputs = recording.inputs.clone()
        inputs[:, columns] /= ratio
        return volumes_along(plant, replace(recording, inputs=inputs))

    written = _written("m^3/s", channels[0], recording)
    yield Correction(f"the flows of {', '.join(channels)} are", "m^3/s", written, fed, tanks, slower)
    read = [sensor.column for sensor in plant.sensors]

    def lower(ratio: float) -> Volumes:
        sensors = tuple(replace(sensor, gain=ratio * sensor.gain) for sensor in plant.sensors)
        return volumes_along(replace(plant, sensors=sensors), recording)

    yield Correction(f"the levels {', '.join(read)} are", "m", _written("m", read[0], recording), fed, tanks, lower)


def _of_a_tank(plant: PlantDescription, as_is: Volumes, among: Sequence[int]) -> Iterator[Correction]:
    """Corrections of the area of one tank."""
    for i in among:
        one = torch.nn.functional.one_hot(torch.tensor(i), len(plant.tanks)).to(as_is.stored)

        def smaller(ratio: float, one: Tensor = one) -> Volumes:
            return _smaller(as_is, ratio**one, 1.0)

        yield Correction(f"tanks.{plant.tanks[i].name}.area is", "m^2", display_unit("m^2")[0], [i], [i], smaller)


def _smaller(volumes: Volumes, tanks: float | Tensor, pipes: float) -> Volumes:
    """The volumes with smaller areas of tanks and pipes."""
    return replace(volumes, stored=volumes.stored / tanks, by_laws=volumes.by_laws / pipes)


def _written(kind: str, channel: str, recording: Recording) -> str:
    """The unit of this kind in which the channel was recorded, or else the usual one."""
    written = recording.written.get(channel, "")
    return written if same_kind(written, (kind,)) else display_unit(kind)[0]
