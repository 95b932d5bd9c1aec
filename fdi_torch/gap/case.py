"""What is to be diagnosed, examined before any fit: what cannot be diagnosed is said in one sentence."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from fdi_torch.effects import effect
from fdi_torch.gap.library import library_of
from fdi_torch.gap.limits import told_limits
from fdi_torch.gap.strays import Strays, strays_of, without
from fdi_torch.gap.subject import Subject, subject_of
from fdi_torch.gap.which import DEEPEST
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.pace import time_scale
from fdi_torch.recording import Recording

LEAST = 60
"""Readings of a sensor below which its noise cannot be told from what a model gets wrong: two of the slowest periods
that still count as noise."""

LONGEST_STEP = 2.5  # s, for tanks on a bench: where a rim is met, fits in longer ones end wherever they began


@dataclass(frozen=True)
class Settings:
    """library, leave_out: as in `library_of`. step: of the simulation, s; None: as in `laid_out`.

    most: effects that one explanation may have. named_only: the best of what has a name, however much it leaves open:
    a step on the way where many causes come together. cross_validate: as in `gap/stretches.py`.
    """

    library: tuple[str, ...] | None = None
    leave_out: tuple[str, ...] = ()
    step: float | None = None
    most: int = DEEPEST
    named_only: bool = False
    cross_validate: bool = False


PLAIN = Settings()


@dataclass(frozen=True)
class Case:
    """library: the effects at places to search. subject: the recordings, for the plant with the limits of its sensors
    that their values tell (`told`); held: the hold-outs. strays: what was masked in the recordings, and in the
    hold-outs. most, named_only, cross_validate: as in `Settings`.
    """

    library: tuple[Placement, ...]
    recordings: tuple[Recording, ...]
    told: list[Placement]
    subject: Subject
    held: tuple[Subject, ...]
    most: int
    named_only: bool = False
    cross_validate: bool = False
    strays: tuple[Sequence[Strays], Sequence[Strays]] = ((), ())


def case_of(
    plant: PlantDescription, recordings: Sequence[Recording], holdouts: Sequence[Recording], settings: Settings
) -> Case:
    """Raises ValueError for what cannot be diagnosed: effects or places that there are not, sensors or inputs that the
    recordings lack, too few readings, a hold-out that is the recording itself.
    """
    for one in holdouts:
        expect_another(one, recordings)
    library = library_of(plant, settings.library, settings.leave_out)
    believed = [Placement(effect(p.effect), p.location, p.parameters) for p in plant.effects]
    recordings, strays = _without_strays(plant, believed, recordings, settings.step)
    holdouts, strays_held = _without_strays(plant, believed, holdouts, settings.step)
    told = told_limits(plant, recordings, believed, library)
    believed += told
    subject, *held = (laid_out(plant, believed, r, settings.step) for r in (recordings, *((h,) for h in holdouts)))
    apart = (strays, strays_held)
    asked = settings.most, settings.named_only, settings.cross_validate
    return Case(library, tuple(recordings), told, subject, tuple(held), *asked, apart)


def _without_strays(
    plant: PlantDescription, believed: Sequence[Placement], recordings: Sequence[Recording], step: float | None
) -> tuple[list[Recording], list[Strays]]:
    """The recordings, what strays in them masked, and that."""
    kept: list[Recording] = []
    found: list[Strays] = []
    columns = {s.name: s.column for s in plant.sensors}
    for recording in recordings:
        mask, own = recording.mask, strays_of(subject_of(plant, believed, recording, step or _step(plant, recording)))
        for strays in own:
            mask = without(mask, strays.each, recording.output_names.index(columns[strays.sensor]))
        kept.append(replace(recording, mask=mask) if own else recording)
        found += own
    return kept, found


def expect_another(holdout: Recording, recordings: Sequence[Recording]) -> None:
    """Raises ValueError where a hold-out is one of the recordings that are diagnosed."""
    same_file = bool(holdout.sha256) and any(_overlap(holdout, r) for r in recordings)
    if same_file or any(holdout is r for r in recordings):
        raise ValueError(
            f"{holdout.source}: expected a hold-out other than the recording, got the same data; what was used for the "
            "fits says nothing of how far the gap closes"
        )


def _overlap(a: Recording, b: Recording) -> bool:
    """Whether both are stretches of one file that have time in common."""
    return a.sha256 == b.sha256 and bool(a.time[0] < b.time[-1]) and bool(b.time[0] < a.time[-1])


def laid_out(
    plant: PlantDescription, believed: Sequence[Placement], recordings: Sequence[Recording], step: float | None
) -> Subject:
    """The recordings on the grid of their simulation. step: s; None for the sampling interval of the first, or a whole
    part of it that is no longer than LONGEST_STEP.
    """
    subject = subject_of(plant, believed, recordings, step or _step(plant, recordings[0]))
    expect_usable(subject)
    return subject


def _step(plant: PlantDescription, recording: Recording) -> float:
    """A whole part of the sampling interval, s."""
    interval = recording.interval
    return interval / math.ceil(interval / (LONGEST_STEP * time_scale(plant)) - 1e-9)


def expect_usable(subject: Subject) -> None:
    """Raises ValueError where a sensor has too few readings."""
    recording, plant = subject.recording, subject.plant
    for sensor, count in zip(plant.sensors, subject.mask.sum(dim=0).tolist(), strict=True):
        if count < LEAST:
            raise ValueError(
                f"{recording.source}: expected at least {LEAST} readings of every sensor, got {count} of "
                f"{sensor.name}; record longer or more often, or leave the sensor out of the plant file"
            )
