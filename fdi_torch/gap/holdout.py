"""The share of the gap that the causes close on hold-outs: free runs with and without the effects.

    closed = 1 - (augmented^2 - noise^2) / (recalibrated^2 - noise^2), in mean squares

Constants and effects come from the diagnosed recordings. Of a hold-out only the initial levels are fitted, to its first
samples. Several hold-outs, each with its own clock, noise and initial levels, are pooled sample by sample.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from torch import Tensor

from fdi_torch.gap.candidate import Candidate, Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.channel_noise import Noise, estimate_noise, with_rounding
from fdi_torch.gap.dataset import DataSet
from fdi_torch.gap.free_form import is_free_coefficient
from fdi_torch.parameters import ParameterName, ParameterSpace, is_effect_parameter
from fdi_torch.plant.effect import Placement
from fdi_torch.simulate.collocation import Collocation

START_SAMPLES = 120  # for the initial levels
BLOCKS, DRAWS = 24, 400  # blocks of time, and draws of the bootstrap
MIN_STANDARD_ERRORS = 5.0  # standard errors; a smaller gap is too uncertain to state a share of it
LOWEST_SHARE = -9.0  # share closed where the causes make a gap many times as large


@dataclass(frozen=True)
class Model:
    """A plant for a free run: its effects, and by full name all values that are not nominal."""

    placements: tuple[Placement, ...] = ()
    values: Mapping[str, float] = field(default_factory=dict)


def model_of(fit: Fit) -> Model:
    """The model of a fit."""
    return Model(fit.candidate.placements, fit.values)


@dataclass(frozen=True)
class HeldOut:
    """Free runs (S, C) of each model on one hold-out, and the noise of the hold-out.

    squares: squared residuals (S, C) of each model, and as "noise_floor" the variance of the noise; 0 where masked. The
    noise is estimated from the residual of the augmented or the recalibrated model, whichever is smaller: a free
    form may diverge outside the range where it was fitted.
    """

    data: DataSet
    runs: Mapping[str, Tensor]
    noise: Noise

    @property
    def weight(self) -> Tensor:
        """Weights (C,) of the squares. Sensors of different units count in standard deviations of their noise."""
        one_unit = len({s.unit for s in self.data.plant.sensors}) == 1
        return torch.ones_like(self.noise.std) if one_unit else 1.0 / self.noise.std.clamp(min=1e-300) ** 2

    @cached_property
    def squares(self) -> Mapping[str, Tensor]:
        each = {model: (self.data.readings - run) ** 2 for model, run in self.runs.items()}
        each["noise_floor"] = self.noise.std.expand_as(self.data.readings) ** 2
        return {model: torch.where(self.data.mask, square, 0.0) for model, square in each.items()}


@dataclass(frozen=True)
class Closure:
    """RMSE of free runs by model, and 'noise_floor', in the reading's SI unit; pooled in standard deviations of the
    noise if units differ.

    closed: None if the gap is too small.
    """

    pooled: dict[str, float]
    per_sensor: dict[str, dict[str, float]]
    closed: float | None
    closed_ci95: tuple[float, float] | None


def run_reference_models(
    data: DataSet, noise: Noise, models: Mapping[str, Model], quantization_steps: Sequence[float]
) -> HeldOut:
    """Free runs of all models by name, "augmented" among them. quantization_steps (C,): 0 for channels without one."""
    runs = {name: free_run(data, noise, model) for name, model in models.items()}
    gains = data.readings.new_tensor([s.gain for s in data.plant.sensors])
    residuals = (data.readings - runs[m] for m in ("augmented", "recalibrated") if m in runs)
    nearest = min(residuals, key=lambda r: float(torch.where(data.mask, (r / gains) ** 2, 0.0).sum()))
    fast = estimate_noise(nearest, data.mask, data.rows, quantization_steps)
    return HeldOut(data, runs, with_rounding(fast, quantization_steps, data.readings - nearest, gains))


def closure(holdouts: Sequence[HeldOut]) -> Closure:
    """The closure over all hold-outs together."""
    models, count = holdouts[0].squares, torch.stack([h.data.mask.sum(dim=0) for h in holdouts]).sum(dim=0)
    pooled, rmse = {}, {}
    for m in models:
        sums = torch.stack([h.squares[m].sum(dim=0) for h in holdouts])
        weighted = torch.stack([(h.weight * h.squares[m]).sum() for h in holdouts])
        pooled[m] = math.sqrt(weighted.sum() / count.sum())
        rmse[m] = torch.sqrt(sums.sum(dim=0) / count.clamp(min=1)).tolist()
    names = [s.name for s in holdouts[0].data.plant.sensors]
    sensors = {s: {m: rmse[m][i] for m in models} for i, s in enumerate(names)}
    return Closure(pooled, sensors, *_closed(holdouts))


def free_run(data: DataSet, noise: Noise, model: Model) -> Tensor:
    """Readings (S, C) of a free run, with initial levels from the first samples."""
    values = transferable_values(model.values)
    early = torch.arange(len(data.mask)).unsqueeze(1) < START_SAMPLES
    fitter = Fitter(replace(data, mask=data.mask & early), noise)
    network = fitter.engine(Candidate(model.placements), [n for n in values if is_effect_parameter(n)]).network
    for name, value in values.items():
        if name in data.plant.varying or ParameterName.parse(name).recording:
            continue  # specific to another recording
        network.nominal[network.constants.index(name)] = value
    starts = [f"{t.name}.start_level" for t in data.plant.tanks]
    engine = Collocation(network, ParameterSpace(network.constants[n] for n in starts), data.experiment)
    theta = engine.space.vector(fitter.first_levels()).unsqueeze(0)
    start = fitter.descend(engine, theta)
    return engine.read(engine.trajectories(start.theta), start.theta)[0]


def transferable_values(values: Mapping[str, float]) -> dict[str, float]:
    """Values of a model that hold for another recording.

    A function of time is replaced by its mean, and sinusoids are dropped, because their phase belongs to the clock of
    the diagnosed recording.
    """
    transferable = dict(values)
    free = [ParameterName.parse(n) for n in values if is_free_coefficient(n)]
    for name in free:
        if name.field.startswith("time_"):
            course = [values[str(n)] for n in free if n.prefix == name.prefix and n.field.startswith("time_")]
            transferable[str(name)] = sum(course) / len(course)
        elif name.field.startswith(("sine_", "cosine_")):
            transferable[str(name)] = 0.0
    return transferable


def _closed(holdouts: Sequence[HeldOut]) -> tuple[float | None, tuple[float, float] | None]:
    """Share closed, at least LOWEST_SHARE, with its 95 % interval over blocks of time. None if the gap, and the change
    of it by the causes, are both below MIN_STANDARD_ERRORS.

    The noise of a hold-out is the same in both runs. The gap is therefore the difference of their squares, plus the
    excess of the augmented run over the noise, as far as it exceeds the uncertainty of the noise.
    """
    difference = torch.cat([_blocks(h.weight * (h.squares["recalibrated"] - h.squares["augmented"])) for h in holdouts])
    excess = sum(float((h.weight * (h.squares["augmented"] - h.squares["noise_floor"])).sum()) for h in holdouts)
    noise_error = math.sqrt(sum(_noise_variance(h) for h in holdouts))
    remaining = max(excess - noise_error, 0.0)
    total, error = float(difference.sum()) + remaining, float(difference.std()) * math.sqrt(len(difference))
    if max(total, -float(difference.sum())) < MIN_STANDARD_ERRORS * min(error, noise_error):
        return None, None
    generator = torch.Generator().manual_seed(0)
    picks = torch.randint(len(difference), (DRAWS, len(difference)), generator=generator)
    drawn_excess = remaining + noise_error * torch.randn(DRAWS, generator=generator, dtype=difference.dtype)
    gap = difference[picks].sum(dim=1) + drawn_excess.clamp(min=0.0)
    drawn = (1.0 - drawn_excess / gap.clamp(min=noise_error)).clamp(LOWEST_SHARE, 1.0)
    low, high = torch.quantile(drawn, torch.tensor([0.025, 0.975], dtype=drawn.dtype)).tolist()
    return max(1.0 - remaining / max(total, noise_error), LOWEST_SHARE), (low, high)


def _noise_variance(held: HeldOut) -> float:
    """Variance of the sum of squares of the noise alone."""
    std, count = held.noise.std * torch.sqrt(held.weight), held.data.mask.sum(dim=0)
    return float((2.0 * std**4 * count * held.noise.squared_correlations).sum())


def _blocks(x: Tensor) -> Tensor:
    """Sums of x (S, C) over blocks of time."""
    return torch.stack([b.sum() for b in torch.tensor_split(x.sum(dim=1), BLOCKS)])
