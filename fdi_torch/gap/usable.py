"""Can this recording be diagnosed at all? Asked before any fit, answered in one sentence where it cannot."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from fdi_torch.gap.fitting import Subject, subject_of
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Placement
from fdi_torch.recording import Recording

LEAST = 60
"""Readings of a sensor below which its noise cannot be told from what a model gets wrong: two of the slowest periods
that still count as noise."""


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
    """The recordings on the grid of their simulation. step: s; None for the sampling interval of the first."""
    interval = float(torch.median(torch.diff(recordings[0].time)))
    subject = subject_of(plant, believed, recordings, step or interval)
    expect_usable(subject)
    return subject


def expect_usable(subject: Subject) -> None:
    """Raises ValueError where a sensor has too few readings."""
    recording, plant = subject.recording, subject.plant
    for sensor, count in zip(plant.sensors, subject.mask.sum(dim=0).tolist(), strict=True):
        if count < LEAST:
            raise ValueError(
                f"{recording.source}: expected at least {LEAST} readings of every sensor, got {count} of "
                f"{sensor.name}; record longer or more often, or leave the sensor out of the plant file"
            )
