"""A plant file on trial: its free run along a recording, whose first samples alone are used, for the start levels.

What the plant file says varies from recording to recording (the zero of a sensor that is zeroed before each run) is
taken from the same samples, within its tolerance: a tank that reads less than nothing is empty, and its sensor off.
Where the recording was cut from a longer one in which a pump had run, its hose is full.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product

import torch
from torch import Tensor

from fdi_torch.effects import effect, once_run
from fdi_torch.gap.fitting import Fitter
from fdi_torch.gap.floor import Noise
from fdi_torch.gap.subject import Subject, subject_of
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.pace import length_scale
from fdi_torch.recording import Recording
from fdi_torch.simulate.collocation import Collocation

START_SAMPLES = 50
ROUNDS, CORRECTIONS, HALVINGS = 30, 80, 4
SETTLED = 1e-5  # m, on a bench
NEARLY = 10.0  # so many times as far, and shorter steps do not help
MOST_STEPS = 4000  # of the first try; samples may be closer, levels do not change as fast
UNSEEN_STARTS = (0.1, 0.25, 0.5, 0.8)  # shares of the height, for a tank that no sensor sees


@dataclass(frozen=True)
class Prediction:
    """readings (S, C) in SI as the plant's sensors have them; start_levels in m; rmse by sensor, over all samples.

    settled: whether the trajectory is the model's to SETTLED, or as much more as tanks are larger; defect, m: by how
    much it is not.
    """

    readings: Tensor
    residuals: Tensor
    start_levels: Mapping[str, float]
    rmse: Mapping[str, float]
    settled: bool
    defect: float


def predict(
    plant: PlantDescription, recording: Recording, start_samples: int = START_SAMPLES, step: float | None = None
) -> Prediction:
    """The free run of the plant as its file has it. step: of the simulation, s; None for half the sampling interval (in
    a long run of close samples the MOST_STEPS-th part of it), and less where a rim that runs over, or another sharp
    bend, keeps the trajectory from settling.

    Raises ValueError where there is no first sample to start from.
    """
    if start_samples < 1:
        raise ValueError(f"expected at least 1 sample for the start levels, got {start_samples}")
    plant = once_run(plant, recording.ran)
    believed = [Placement(effect(p.effect), p.location, p.parameters) for p in plant.effects]
    span = float(recording.time[-1] - recording.time[0])
    step = step or max(0.5 * float(torch.median(torch.diff(recording.time))), span / MOST_STEPS)
    left = math.inf
    for _ in range(HALVINGS):
        subject = subject_of(plant, believed, recording, step)
        found, before = _run(subject, start_samples), left
        left = found.defect
        stuck = left < NEARLY * SETTLED * length_scale(plant) and left > 0.5 * before
        if found.settled or stuck:  # an empty tank flickers at its floor, whatever the step
            break
        step *= 0.5
    return found


def _run(subject: Subject, start_samples: int) -> Prediction:
    plant, recording = subject.plant, subject.recording
    early = subject.mask.clone()
    early[start_samples:] = False
    if not bool(early.any()):
        raise ValueError(f"{recording.source}: expected readings among the first {start_samples} samples, got none")
    spread = subject.readings.nan_to_num().std(dim=0).clamp(min=1e-9)
    fitter = Fitter(replace(subject, mask=early), Noise(1e-2 * spread, torch.zeros_like(spread)))
    network = fitter.network([])
    tanks = [f"{t.name}.start_level" for t in plant.tanks]
    names = [*tanks, *plant.varying]
    engine = Collocation(network, ParameterSpace(network.constants[n] for n in names), subject.experiment)
    theta = torch.stack([engine.space.vector(start) for start in _starts(plant, fitter.first_levels())])
    theta, cost, near = fitter.descend(engine, theta, engine.settle(theta, engine.constant_guess(theta)).levels, ROUNDS)
    best = int(torch.nan_to_num(cost, nan=torch.inf).argmin())
    run = engine.settle(theta[best : best + 1], near.levels[best : best + 1], CORRECTIONS)
    readings = run.readings[0]
    residuals = torch.where(subject.mask, subject.readings - readings, torch.zeros_like(readings))
    rmse = torch.sqrt((residuals**2).sum(dim=0) / subject.mask.sum(dim=0))
    return Prediction(
        readings,
        residuals,
        dict(zip((t.name for t in plant.tanks), theta[best].tolist(), strict=False)),
        dict(zip((s.name for s in plant.sensors), rmse.tolist(), strict=True)),
        float(run.defect.max()) < SETTLED * length_scale(plant),
        float(run.defect.max()),
    )


def _starts(plant: PlantDescription, seen: Mapping[str, float]) -> list[dict[str, float]]:
    """Where the descent begins: levels as first read; several where no sensor tells."""
    unseen = [t for t in plant.tanks if f"{t.name}.start_level" not in seen]
    grids = [[(f"{t.name}.start_level", share * t.height) for share in UNSEEN_STARTS] for t in unseen]
    return [{**seen, **dict(choice)} for choice in product(*grids)]
