"""Before any data: which effects a planned input can never show, and which it can never tell apart.

The plant file's own prediction takes the place of readings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from fdi_torch.effects import effect
from fdi_torch.gap.excitation import Excitation, excitation
from fdi_torch.gap.fitting import Candidate, Fitter
from fdi_torch.gap.floor import Noise
from fdi_torch.gap.library import library_of
from fdi_torch.gap.screening import options_of, screen
from fdi_torch.gap.subject import subject_of
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.operating_range import operating_range_of
from fdi_torch.recording import Recording


def plan(
    plant: PlantDescription, recording: Recording, noise: float, library: Sequence[str] | None = None
) -> Excitation:
    """recording: planned inputs; what was read, if anything, is not looked at. noise: std of a reading, its unit."""
    believed = [Placement(effect(p.effect), p.location, p.parameters) for p in plant.effects]
    step = float(torch.median(torch.diff(recording.time)))
    fitter = _noise_free(plant, believed, recording, step, noise)
    null = fitter.fit(Candidate())
    seen = replace(fitter.subject.recording, outputs=null.near.readings[0])
    placements = [p for p in library_of(plant, library) if not p.effect.quantizes]
    options = options_of(placements, fitter, operating_range_of(seen, plant))
    return excitation(screen(fitter, null, options), plant)


def _noise_free(
    plant: PlantDescription, believed: Sequence[Placement], recording: Recording, step: float, noise: float
) -> Fitter:
    """A fitter whose readings are what the plant file predicts, from its start levels or from rest."""
    sensors = len(plant.sensors)
    names = tuple(s.column for s in plant.sensors)
    units = tuple(s.unit for s in plant.sensors)
    blank = torch.zeros(len(recording), sensors, dtype=torch.float64)
    planned = replace(
        recording, outputs=blank, output_names=names, output_units=units, mask=torch.ones_like(blank, dtype=torch.bool)
    )
    subject = subject_of(plant, believed, planned, step)
    white = Noise(torch.full((sensors,), noise, dtype=torch.float64), torch.zeros(sensors, dtype=torch.float64))
    engine = Fitter(subject, white).engine(Candidate(), ())
    theta = engine.space.nominal().unsqueeze(0)
    readings = engine.converge(theta, engine.constant_guess(theta), rounds=30).readings[0]
    return Fitter(replace(subject, readings=readings, recording=replace(planned, outputs=readings)), white)
