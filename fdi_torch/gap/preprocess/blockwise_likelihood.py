"""Likelihood of a recording under a model whose errors have an unknown size and a known correlation time.

    log p(y | D) = -1/2 sum_c n_c log v_c - chi^2(tolerances) / 2 + log prior

- v_c: mean square of the residual of channel c, averaged over blocks of two time constants tau of the plant, or over
  FEWEST_BLOCKS shorter ones; at least the variance of the sensor noise in such a mean.
- n_c = T / (2 tau), at least 1: number of independent values of a model error that decays with tau (Bartlett, 1946).
  The size of the error is integrated out under Jeffreys' prior.

Each channel is weighted by its own v_c, so that one wrong channel does not bias the fit of the others: sensors that
agree through the plant's equations outvote it (generalised observers: Frank, 1990, Automatica 26, 459-474).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from fdi_torch.effects import effects_of
from fdi_torch.gap.candidate import Candidate, Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.channel_noise import Noise
from fdi_torch.gap.dataset import DataSet, data_set_of
from fdi_torch.gap.trajectory_problem import GIVE_UP_DEFICIT, GIVE_UP_SHARE, MAX_EVALUATIONS
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.constants import flow_scale, reading_span
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording
from fdi_torch.recordings.repeated_readings import scatter

SAMPLES = 1200
"""Recordings are thinned to at most this many samples, because recording faults already show at the time scale of the
plant."""
ROUNDS = 3
"""Alternations between the fit and the variances of its residuals."""
BROAD = 0.1
"""Standard deviation of a residual before the first fit, as a share of the sensor's span."""
FEWEST_BLOCKS = 8
"""The free initial level makes the mean residual of a short recording zero, whatever the model: its blocks are so short
that this hides little of the error."""
EXACT = 1e-5
"""Error of the simulation in steps of thinned samples, as a share of the sensor's span."""


@dataclass(frozen=True)
class BlockedRecording:
    """A thinned recording of a plant, divided into blocks of time.

    noise (C,): smallest v_c, in the sensors' units squared. blocks: their number. errors: independent values of a model
    error in them, T / (2 tau).
    """

    plant: PlantDescription
    recording: Recording
    data: DataSet
    noise: Tensor
    blocks: float
    errors: float

    @cached_property
    def block(self) -> Tensor:
        """Index of the block of each sample, (S,)."""
        time = self.recording.time - self.recording.time[0]
        return (time / float(time[-1]) * self.blocks * (1.0 - 1e-9)).long()

    def means(self, x: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Block means (B, C, *) of x (S, C, *) over the samples in mask (S, C), and their number (B, C)."""
        blocks, each = int(self.block[-1]) + 1, (..., *(None,) * (x.dim() - 2))
        count = x.new_zeros(blocks, x.shape[1]).index_add(0, self.block, mask.to(x.dtype))
        total = x.new_zeros(blocks, *x.shape[1:]).index_add(0, self.block, torch.where(mask[each], x, 0.0))
        return total / count.clamp(min=1.0)[each], count

    def variance(self, residual: Tensor) -> Tensor:
        """v_c (C,) of residuals (S, C)."""
        return self.variance_of_means(*self.means(residual, self.data.mask))

    def variance_of_means(self, means: Tensor, count: Tensor) -> Tensor:
        """v_c (C,) of the block means (B, C) of residuals, of so many valid samples each."""
        mean_square = (count * means**2).sum(dim=0) / count.sum(dim=0).clamp(min=1.0)
        return torch.maximum(mean_square, self.noise)


@dataclass(frozen=True)
class BlockwiseFit:
    """The plant fitted to a recording. variance (C,): v_c. means (C,): n_c. prior_chi_square: of the tolerances."""

    blocked: BlockedRecording
    fit: Fit
    variance: Tensor
    means: Tensor
    prior_chi_square: float

    @property
    def fitter(self) -> Fitter:
        """A fitter whose noise has the size of the residuals."""
        return _fitter(self.blocked.data, self.variance, self.means)

    @property
    def readings(self) -> Tensor:
        """Predicted readings (S, C)."""
        return self.fit.linearised.readings[0]

    @property
    def log_likelihood(self) -> float:
        return -0.5 * float((self.means * torch.log(self.variance)).sum()) - 0.5 * self.prior_chi_square

    @property
    def most(self) -> float:
        """The log-likelihood of a fit whose residuals are sensor noise only."""
        return -0.5 * float((self.means * torch.log(self.blocked.noise)).sum())


def slowest(plant: PlantDescription) -> float:
    """The largest time constant (s) of a full tank: volume over outflow."""
    return max(t.area * t.height / flow_scale(plant, t.name) for t in plant.tanks)


def blocked_recording(plant: PlantDescription, recording: Recording, noise: Tensor) -> BlockedRecording:
    """Thin a recording to at most about SAMPLES samples, and divide it into blocks. noise (C,): as of `noise_of`."""
    thinned = recording.every(max(1, len(recording) // SAMPLES))
    nominal_effects = effects_of(plant)
    data = data_set_of(plant, nominal_effects, thinned, float(torch.median(torch.diff(thinned.time))))
    errors = max(float(thinned.time[-1] - thinned.time[0]) / (2.0 * slowest(plant)), 1.0)
    blocks = max(errors, FEWEST_BLOCKS)
    spans = torch.tensor([reading_span(plant, s) for s in plant.sensors], dtype=torch.float64)
    least = noise**2 * blocks / len(thinned) + (EXACT * spans) ** 2
    return BlockedRecording(plant, thinned, data, least, blocks, errors)


def noise_of(plant: PlantDescription, recording: Recording) -> Tensor:
    """Standard deviation (C,) of each sensor's noise, quantization included, in the units of the readings."""
    scatters = [scatter(recording.valid_readings(column)) for column in plant.outputs()]
    return torch.tensor([math.hypot(s.noise, s.step / math.sqrt(12.0)) for s in scatters], dtype=torch.float64)


def blockwise_fit(
    blocked: BlockedRecording,
    candidate: Candidate = Candidate(),  # noqa: B008
    base: BlockwiseFit | None = None,
    cap: int = MAX_EVALUATIONS,
    target: float = -math.inf,
) -> BlockwiseFit:
    """Fit the plant, with the effects of a candidate, within its tolerances.

    cap: maximum number of evaluations of one fit. target: log-likelihood of the competitor; a fit that approaches it
    too slowly is given up, as in `Fitter.fit`.
    """
    data = blocked.data
    spans = torch.tensor([reading_span(blocked.plant, s) for s in blocked.plant.sensors], dtype=torch.float64)
    variance = (BROAD * spans) ** 2 if base is None else base.variance
    fit = base.fit if base else None
    _, samples = blocked.means(data.readings, data.mask)
    means = (samples > 0).sum(dim=0).to(torch.float64) * blocked.errors / (int(blocked.block[-1]) + 1)
    before = base.log_likelihood if base else -math.inf
    for _ in range(ROUNDS):
        fitter = _fitter(data, variance, means)
        start = Candidate(candidate.placements, (fit.effect_values,)) if fit and fit.key == candidate.key else candidate
        fit = fitter.fit(start, fit, cap=cap)
        variance = blocked.variance(data.readings - fit.linearised.readings[0])
        fitted = BlockwiseFit(blocked, fit, variance, means, prior_chi_square(fit, fit.theta))
        behind = target - fitted.log_likelihood
        if behind > 0.5 * GIVE_UP_DEFICIT and fitted.log_likelihood - before < GIVE_UP_SHARE * behind:
            break
        before = fitted.log_likelihood
    return fitted


def _fitter(data: DataSet, variance: Tensor, means: Tensor) -> Fitter:
    """A fitter that gives each channel the weight of its v_c."""
    std = torch.sqrt(variance * data.mask.sum(dim=0).clamp(min=1) / means.clamp(min=1.0))
    return Fitter(data, Noise.white(std))


def prior_chi_square(fit: Fit, theta: Tensor) -> float:
    """Chi-square of the constants theta (P,) against their tolerances."""
    deviation = ((theta - fit.space.nominal(theta)) / fit.space.std(theta)).nan_to_num(0.0)
    constants = torch.tensor([ParameterName.parse(n).is_constant for n in fit.space.names])
    return float((deviation[constants] ** 2).sum())
