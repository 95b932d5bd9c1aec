"""The data set of a diagnosis: a plant, and one or several recordings on the grid of their simulation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from fdi_torch.parameters import name_in_recording
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.network import TankNetwork
from fdi_torch.recording import Recording
from fdi_torch.simulate.experiment import Experiment, lay_out
from fdi_torch.simulate.joint_collocation import with_blanks
from fdi_torch.simulate.resampling import interpolate, step_means

FEWEST = 0.5
"""Minimum number of valid readings of a mean, as a share of the usual number in a step; it limits the variance to twice
the usual one."""


@dataclass(frozen=True)
class RecordingPart:
    """One recording of a data set on its simulation grid.

    readings, mask: (S, C), in the plant's order of sensors, at the samples of the experiment. These are the samples of
    the recording, or one per integration step with their mean.
    """

    recording: Recording
    experiment: Experiment
    readings: Tensor
    mask: Tensor

    def first_levels(self, plant: PlantDescription) -> dict[str, float]:
        """Initial levels of the tanks with sensors from the mean of the first readings, m, by name."""
        levels = {}
        for i, sensor in enumerate(plant.sensors):
            readings = self.readings[:5, i][self.mask[:5, i]]
            if len(readings):
                levels[f"{sensor.tank}.start_level"] = max(float(readings.mean() - sensor.offset) / sensor.gain, 0.0)
        return levels


@dataclass(frozen=True, eq=False)
class DataSet:
    """A plant with its nominal effects, and one or several recordings of it.

    readings, mask (S, C): of all recordings, with one masked row between two.
    """

    plant: PlantDescription
    nominal_effects: tuple[Placement, ...]
    recordings: tuple[Recording, ...]
    experiments: tuple[Experiment, ...]
    readings: Tensor
    mask: Tensor

    @property
    def recording(self) -> Recording:
        """The first recording."""
        return self.recordings[0]

    @property
    def experiment(self) -> Experiment:
        """The experiment of the first recording."""
        return self.experiments[0]

    @property
    def further(self) -> tuple[Recording, ...]:
        """The recordings after the first."""
        return self.recordings[1:]

    @property
    def parts(self) -> tuple[RecordingPart, ...]:
        each = zip(self.recordings, self.experiments, self.rows, strict=True)
        return tuple(RecordingPart(r, e, self.readings[rows], self.mask[rows]) for r, e, rows in each)

    @property
    def row_spacing(self) -> float:
        """Median time between rows, s."""
        return float(torch.cat([torch.diff(experiment.sample_times) for experiment in self.experiments]).median())

    @property
    def longest_duration(self) -> float:
        """Duration of the longest recording, s."""
        return max(float(experiment.nodes[-1]) for experiment in self.experiments)

    @property
    def rows(self) -> tuple[slice, ...]:
        """The rows of each recording among all."""
        slices, first = [], 0
        for experiment in self.experiments:
            slices.append(slice(first, first + len(experiment.sample_times)))
            first = slices[-1].stop + 1
        return tuple(slices)

    def recorded(self, channel: int) -> Tensor:
        """All valid readings of a channel as recorded."""
        column = self.plant.sensors[channel].column
        return torch.cat([recording.valid_readings(column) for recording in self.recordings])

    def alone(self, recording: int) -> DataSet:
        """A data set of one of the recordings."""
        part = self.parts[recording]
        return DataSet(
            self.plant, self.nominal_effects, (part.recording,), (part.experiment,), part.readings, part.mask
        )

    @cached_property
    def per_recording(self) -> tuple[str, ...]:
        """Parameters that each recording has for itself: initial levels, constants that vary between recordings."""
        return (*self.plant.varying, *(f"{t.name}.start_level" for t in self.plant.tanks))

    @cached_property
    def nuisance(self) -> tuple[str, ...]:
        """Parameters refitted with every candidate: initial levels; constants and effect parameters with tolerance."""
        constants = TankNetwork(self.plant, self.nominal_effects).constants
        common = [p.name for p in constants if math.isfinite(p.std) and p.name not in self.per_recording]
        per_recording = [name_in_recording(n, k) for k in range(len(self.recordings)) for n in self.per_recording]
        return (*common, *per_recording)


def data_set_of(
    plant: PlantDescription,
    nominal_effects: Sequence[Placement],
    recordings: Recording | Sequence[Recording],
    step: float,
    averaged: bool = False,
) -> DataSet:
    """Lay recordings out on their simulation grid, step s. Raises ValueError if one lacks a sensor.

    averaged: whether readings of one integration step are replaced by their mean, as in `resampling`.
    """
    each = [recordings] if isinstance(recordings, Recording) else recordings
    parts = [_part(plant, recording, step, averaged) for recording in each]
    readings, mask = (with_blanks([getattr(p, name) for p in parts], dim=0) for name in ("readings", "mask"))
    experiments = tuple(part.experiment for part in parts)
    return DataSet(plant, tuple(nominal_effects), tuple(each), experiments, readings, mask)


def at_recorded_times(data: DataSet, values: Tensor) -> Tensor:
    """Values (S, C) at the rows of a data set of one recording, interpolated to the samples of the recording."""
    time = data.recording.time - data.recording.time[0]
    return torch.stack([interpolate(time, data.experiment.sample_times, column) for column in values.T], dim=1)


def _part(plant: PlantDescription, recording: Recording, step: float, averaged: bool) -> RecordingPart:
    order = recording.output_columns(plant.outputs())
    experiment = lay_out(recording, plant.channels(), step)
    readings, mask = recording.outputs[:, order], recording.mask[:, order]
    if averaged:
        experiment, readings, counts = step_means(experiment, readings, mask)
        usual = torch.where(counts > 0, counts, torch.nan).nanmedian(dim=0).values
        mask = counts >= FEWEST * usual
    return RecordingPart(recording, experiment, readings, mask)
