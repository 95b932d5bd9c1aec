"""How likely a recording is where all that is known of the model's error is how long it keeps.

    log p(y | D) = -1/2 sum_c n_c log v_c - chi^2(tolerances) / 2 + log prior

v_c is the mean square of channel c's residual, in means over two time constants tau of the plant, no less than its
noise in such a mean, and n_c = T / (2 tau) the number of means: so many independent values has an error of the model
that dies away with tau (Bartlett, 1946), and no size of it is likelier than another (a scale that is integrated out
under Jeffreys' prior). Fits weigh each channel by its v_c, so that one that errs does not bend the others: sensors that
agree by the plant's equations outvote it (generalised observers: Frank, 1990, Automatica 26, 459-474).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from fdi_torch.effects import effect
from fdi_torch.gap.fitting import CAP, Candidate, Fit, Fitter
from fdi_torch.gap.floor import Noise
from fdi_torch.gap.subject import Subject, subject_of
from fdi_torch.plant.constants import flow_scale, reading_span
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Placement
from fdi_torch.recording import Recording
from fdi_torch.recordings.repeated_readings import scatter

SAMPLES = 1200
"""A recording is thinned to at most so many: slips show as slowly as the plant moves."""
ROUNDS = 3
"""Fit and variances of its residuals are worked out in turn so often."""
BROAD = 0.1
"""Share of the span of a sensor that a residual is believed to have before the first fit."""
EXACT = 1e-5
"""The same share: the simulation's own error in steps of thinned samples."""


@dataclass(frozen=True)
class Case:
    """A recording, thinned, of a plant. noise (C,): least v_c, in the sensors' units squared. blocks: T / (2 tau)."""

    plant: PlantDescription
    recording: Recording
    subject: Subject
    noise: Tensor
    blocks: float

    @cached_property
    def block(self) -> Tensor:
        """Of which mean each sample is part, (S,)."""
        time = self.recording.time - self.recording.time[0]
        return (time / float(time[-1]) * self.blocks * (1.0 - 1e-9)).long()

    def means(self, x: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """x (S, C) -> its mean in each block (B, C), and how many samples count there."""
        count = torch.zeros(int(self.block[-1]) + 1, x.shape[1], dtype=x.dtype)
        total = count.index_add(0, self.block, torch.where(mask, x, 0.0))
        count = count.index_add(0, self.block, mask.to(x.dtype))
        return total / count.clamp(min=1.0), count


@dataclass(frozen=True)
class Run:
    """The fitted plant beside a recording. variance (C,): v_c; means (C,): n_c; pull: chi-square of the tolerances."""

    case: Case
    fit: Fit
    variance: Tensor
    means: Tensor
    pull: float

    @property
    def readings(self) -> Tensor:
        """What it would read, (S, C)."""
        return self.fit.near.readings[0]

    @property
    def log_likelihood(self) -> float:
        return -0.5 * float((self.means * torch.log(self.variance)).sum()) - 0.5 * self.pull

    @property
    def most(self) -> float:
        """The log-likelihood of a run that leaves nothing but noise."""
        return -0.5 * float((self.means * torch.log(self.case.noise)).sum())


def slowest(plant: PlantDescription) -> float:
    """The slowest time constant of a full tank, s: volume over outflow."""
    return max(t.area * t.height / flow_scale(plant, t.name) for t in plant.tanks)


def thinned(recording: Recording) -> Recording:
    return recording.every(max(1, len(recording) // SAMPLES))


def laid_out(plant: PlantDescription, recording: Recording, noise: Tensor) -> Case:
    """recording: thinned. noise (C,): standard deviation of each sensor's readings, in the plant's order."""
    believed = [Placement(effect(p.effect), p.location, p.parameters) for p in plant.effects]
    subject = subject_of(plant, believed, recording, float(torch.median(torch.diff(recording.time))))
    blocks = max(float(recording.time[-1] - recording.time[0]) / (2.0 * slowest(plant)), 1.0)
    spans = torch.tensor([reading_span(plant, s) for s in plant.sensors], dtype=torch.float64)
    floor = noise**2 * blocks / len(recording) + (EXACT * spans) ** 2
    return Case(plant, recording, subject, floor, blocks)


def noise_of(plant: PlantDescription, recording: Recording) -> Tensor:
    """Standard deviation of each sensor's noise, rounding included, in the plant's order and the readings' units."""
    found = []
    for sensor in plant.sensors:
        column = recording.output_names.index(sensor.column)
        own = scatter(recording.outputs[recording.mask[:, column], column])
        found.append(math.hypot(own.noise, own.step / math.sqrt(12.0)))
    return torch.tensor(found, dtype=torch.float64)


def run(
    case: Case,
    candidate: Candidate = Candidate(),  # noqa: B008
    base: Run | None = None,
    cap: int = CAP,
    rounds: int = ROUNDS,
) -> Run:
    """The plant, with the effects of a candidate, fitted within its tolerances. cap: evaluations of a fit, at most."""
    subject, channels = case.subject, len(case.plant.sensors)
    spans = torch.tensor([reading_span(case.plant, s) for s in case.plant.sensors], dtype=torch.float64)
    variance = (BROAD * spans) ** 2 if base is None else base.variance
    fit = base.fit if base else None
    _, samples = case.means(subject.readings, subject.mask)
    means = (samples > 0).sum(dim=0).to(torch.float64) * case.blocks / (int(case.block[-1]) + 1)
    count = subject.mask.sum(dim=0)
    for _ in range(rounds):
        each = torch.sqrt(variance * count.clamp(min=1) / means.clamp(min=1.0))
        fitter = Fitter(subject, Noise(each, torch.zeros(channels, dtype=torch.float64)))
        begin = Candidate(candidate.placements, (fit.effect_values,)) if fit and fit.key == candidate.key else candidate
        fit = fitter.fit(begin, fit, cap=cap)
        residual, samples = case.means(subject.readings - fit.near.readings[0], subject.mask)
        mean_square = (samples * residual**2).sum(dim=0) / samples.sum(dim=0).clamp(min=1.0)
        variance = torch.maximum(mean_square, case.noise)
    assert fit is not None
    off = ((fit.theta - fit.space.nominal(fit.theta)) / fit.space.std(fit.theta)).nan_to_num(0.0)
    constants = torch.tensor([n.count(".") == 1 for n in fit.space.names])
    return Run(case, fit, variance, means, float((off[constants] ** 2).sum()))
