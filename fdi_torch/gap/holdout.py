"""How far the gap shrinks on data not used for any fit: free runs of the hold-outs, with and without the effects.

    closed = 1 - (augmented^2 - floor^2) / (recalibrated^2 - floor^2), in mean squares

Constants and effects come from the recording; of a hold-out only the start levels are fitted, to its first samples.
Several hold-outs, each with its own clock, noise and start levels, count sample by sample.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.gap.candidate_fit import Candidate, Fit, Fitter
from fdi_torch.gap.dataset import DataSet
from fdi_torch.gap.noise_model import Noise, estimate_noise, with_rounding
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.effect import Placement
from fdi_torch.simulate.collocation import Collocation

START_SAMPLES = 120
BLOCKS, DRAWS = 24, 400
DEFINED = 5.0  # standard errors that a gap has to measure before a share of it means anything


@dataclass(frozen=True)
class Model:
    """A plant to run freely: its effects, and the values of what is not nominal, by full name."""

    placements: tuple[Placement, ...] = ()
    values: Mapping[str, float] | None = None


def model_of(fit: Fit) -> Model:
    return Model(fit.candidate.placements, fit.values)


@dataclass(frozen=True)
class HeldOut:
    """Free runs (S, C) of each model on one hold-out, and the noise found about the augmented one, or the recalibrated
    one where that stays nearer: a free form may run away where it was not fitted."""

    data: DataSet
    runs: Mapping[str, Tensor]
    noise: Noise

    @property
    def weight(self) -> Tensor:
        """(C,): by which squares of all sensors add up. Sensors of several units count in levels of their noise."""
        alike = len({s.unit for s in self.data.plant.sensors}) == 1
        return torch.ones_like(self.noise.std) if alike else 1.0 / self.noise.std.clamp(min=1e-300) ** 2

    def squares(self, model: str) -> Tensor:
        """Squared residuals (S, C), 0 where no reading counts."""
        residual = self.data.readings - self.runs[model]
        return torch.where(self.data.mask, residual * residual, 0.0)


@dataclass(frozen=True)
class Closure:
    """RMSE of free runs by model and 'noise_floor', in the reading's SI unit, pooled in levels of the noise where units
    differ; closed is None where the gap is too small to be shared out."""

    pooled: dict[str, float]
    per_sensor: dict[str, dict[str, float]]
    closed: float | None
    closed_ci95: tuple[float, float] | None


def run_reference_models(
    data: DataSet, noise: Noise, models: Mapping[str, Model], quantization_steps: Sequence[float]
) -> HeldOut:
    """models: by the answer's names, "augmented" among them. lattice (C,): the step of each rounded channel, or 0."""
    runs, levels = {}, None
    for name, model in models.items():
        runs[name], levels = free_run(data, noise, model, levels)
    residuals = (data.readings - runs[m] for m in ("augmented", "recalibrated") if m in runs)
    nearest = min(residuals, key=lambda r: float(torch.where(data.mask, r * r, 0.0).sum()))
    fast = estimate_noise(nearest, data.mask, quantization_steps)
    return HeldOut(data, runs, with_rounding(fast, quantization_steps, data.readings - nearest))


def closure(held: Sequence[HeldOut]) -> Closure:
    """All hold-outs together."""
    count = torch.stack([h.data.mask.sum(dim=0) for h in held]).sum(dim=0)
    sums = {m: torch.stack([h.squares(m).sum(dim=0) for h in held]).sum(dim=0) for m in held[0].runs}
    sums["noise_floor"] = torch.stack([h.noise.std**2 * h.data.mask.sum(dim=0) for h in held]).sum(dim=0)
    own = {m: torch.stack([(h.weight * h.squares(m)).sum() for h in held]).sum() for m in held[0].runs}
    own["noise_floor"] = torch.stack([(h.weight * h.noise.std**2 * h.data.mask).sum() for h in held]).sum()
    pooled = {m: float(torch.sqrt(total / count.sum())) for m, total in own.items()}
    each = {m: torch.sqrt(total / count.clamp(min=1)) for m, total in sums.items()}
    names = [s.name for s in held[0].data.plant.sensors]
    sensors = {s: {m: float(v[i]) for m, v in each.items()} for i, s in enumerate(names)}
    return Closure(pooled, sensors, *_closed(held))


def free_run(data: DataSet, noise: Noise, model: Model, guess: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Readings (S, C) and levels (1, K+1, tanks) of a run with constants as the model has them and start levels from
    the first samples. guess (1, K+1, tanks): levels to begin with.
    """
    values = transferable_values(model.values or {})
    fitter = Fitter(replace(data, mask=_first(data.mask)), noise)
    network = fitter.engine(Candidate(model.placements), [n for n in values if n.count(".") == 2]).network
    for name, value in values.items():
        if name.partition("@")[0] in data.plant.varying or "@" in name:
            continue  # what another recording had for itself
        network.nominal[network.constants.index(name)] = value
    starts = [f"{t.name}.start_level" for t in data.plant.tanks]
    engine = Collocation(network, ParameterSpace(network.constants[n] for n in starts), data.experiment)
    theta = engine.space.vector(fitter.first_levels()).unsqueeze(0)
    if guess is None:  # what all readings show leads to the model's own trajectory; it does not tell where that is
        levels = Fitter(data, noise).first_trajectory(engine, theta)
    else:
        levels = engine.converge(theta, guess).levels
    start = fitter.descend(engine, theta, levels)
    settled = engine.converge(start.theta, start.linearised.levels)
    return settled.readings[0], settled.levels


def transferable_values(values: Mapping[str, float]) -> dict[str, float]:
    """What of a model holds on another day: of a free form's course in time its mean, of its waves, whose phase belongs
    to the recording's own clock, nothing.
    """
    courses: dict[str, list[float]] = {}
    for name, value in values.items():
        if _free_part(name).startswith("time_"):
            courses.setdefault(name.rpartition(".")[0], []).append(value)
    carried = dict(values)
    for name in values:
        course = courses.get(name.rpartition(".")[0], [0.0])
        if _free_part(name).startswith("time_"):
            carried[name] = sum(course) / len(course)
        elif _free_part(name).startswith(("sine_", "cosine_")):
            carried[name] = 0.0
    return carried


def _free_part(name: str) -> str:
    """The coefficient of a free form, '' for the parameter of anything else."""
    return name.rpartition(".")[2] if ".free_" in name else ""


def _first(mask: Tensor) -> Tensor:
    early = mask.clone()
    early[START_SAMPLES:] = False
    return early


def _closed(held: Sequence[HeldOut]) -> tuple[float | None, tuple[float, float] | None]:
    """The share closed and its 95 % interval over blocks of time; None where the gap is under 5 standard errors.

    The noise of a hold-out is the same in both runs, so that the gap is their difference, plus what the augmented
    run leaves; the latter counts as far as it stands out of the uncertainty of the floor.
    """
    difference = torch.cat([_blocks(h.weight * (h.squares("recalibrated") - h.squares("augmented"))) for h in held])
    excess = sum(float((h.weight * (h.squares("augmented") - h.noise.std**2 * h.data.mask)).sum()) for h in held)
    uncertain = math.sqrt(sum(_floor_variance(h) for h in held))
    left = math.copysign(max(abs(excess) - uncertain, 0.0), excess)
    total, error = float(difference.sum()) + max(left, 0.0), float(difference.std()) * math.sqrt(len(difference))
    if total < DEFINED * min(error, uncertain) or total <= 0.0:
        return None, None
    generator = torch.Generator().manual_seed(0)
    pick = torch.randint(len(difference), (DRAWS, len(difference)), generator=generator)
    rest = max(left, 0.0) + uncertain * torch.randn(DRAWS, generator=generator, dtype=difference.dtype)
    drawn = 1.0 - rest / (difference[pick].sum(dim=1) + rest.clamp(min=0.0)).clamp(min=1e-300)
    low, high = torch.quantile(drawn, torch.tensor([0.025, 0.975], dtype=drawn.dtype)).tolist()
    return 1.0 - max(left, 0.0) / total, (max(low, -9.0), min(high, 1.0))


def _floor_variance(held: HeldOut) -> float:
    """Of the sum of squares that the noise alone gives."""
    std, count = held.noise.std * torch.sqrt(held.weight), held.data.mask.sum(dim=0)
    return float((2.0 * std**4 * count * held.noise.squared_correlations).sum())


def _blocks(x: Tensor) -> Tensor:
    """(S, C) -> sums over blocks of time."""
    return torch.stack([b.sum() for b in torch.tensor_split(x.sum(dim=1), BLOCKS)])
