"""How far the gap shrinks on data not used for any fit: free runs of the hold-out, with and without the effects.

    closed = 1 - (augmented^2 - floor^2) / (recalibrated^2 - floor^2), in mean squares

Constants and effects come from the recording; of the hold-out only the start levels are fitted, to its first samples.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.gap.fitting import Candidate, Fit, Fitter, Subject
from fdi_torch.gap.floor import Noise, estimate_noise, with_rounding
from fdi_torch.parameters import ParameterSpace
from fdi_torch.simulate.collocation import Collocation

START_SAMPLES = 120
BLOCKS, DRAWS = 24, 400
DEFINED = 5.0  # standard errors that a gap has to measure before a share of it means anything


@dataclass(frozen=True)
class Closure:
    """Free-run RMSE on the hold-out, in the unit shown; closed is None where the gap is too small to be shared out."""

    unit: str
    per_sensor: dict[str, dict[str, float]]
    pooled: dict[str, float]
    closed: float | None
    closed_ci95: tuple[float, float] | None
    residuals: dict[str, Tensor]


def closure(
    subject: Subject, noise: Noise, fits: Mapping[str, Fit | None], lattice: Sequence[float], scale: float, unit: str
) -> Closure:
    """fits: by the names of the answer ('nominal' has None). lattice (C,): the step of each rounded channel, or 0."""
    residuals = {name: free_run(subject, noise, fit) for name, fit in fits.items()}
    fast = estimate_noise(residuals["augmented"], subject.mask, [step > 0.0 for step in lattice])
    found = with_rounding(fast, lattice, subject.readings - residuals["augmented"])
    floor = found.std
    mask = subject.mask
    squares = {name: torch.where(mask, r * r, 0.0) for name, r in residuals.items()}
    count = mask.sum(dim=0)
    names = [s.name for s in subject.plant.sensors]
    each = {name: torch.sqrt(s.sum(dim=0) / count) for name, s in squares.items()} | {"noise_floor": floor}
    pooled = {name: float(torch.sqrt((v * v * count).sum() / count.sum())) * scale for name, v in each.items()}
    sensors = {s: {name: float(v[i]) * scale for name, v in each.items()} for i, s in enumerate(names)}
    closed, interval = _closed(squares["recalibrated"], squares["augmented"], mask, found)
    return Closure(unit, sensors, pooled, closed, interval, residuals)


def free_run(subject: Subject, noise: Noise, fit: Fit | None) -> Tensor:
    """Residual (S, C) of a run with constants as fitted (or as believed) and start levels from the first samples."""
    candidate = fit.candidate if fit else Candidate()
    free = [n for n in fit.space.names if n.count(".") == 2] if fit else []
    fitter = Fitter(replace(subject, mask=_first(subject.mask)), noise)
    network = fitter.engine(candidate, free).network
    if fit:
        for name, value in fit.values.items():
            # A free course in time belongs to the recording's own clock and tells nothing of another day.
            timed = name.rpartition(".")[2].startswith("time_") and ".free_" in name
            network.nominal[network.constants.index(name)] = 0.0 if timed else value
    starts = [f"{t.name}.start_level" for t in subject.plant.tanks]
    engine = Collocation(network, ParameterSpace(network.constants[n] for n in starts), subject.experiment)
    theta = engine.space.vector(fitter.first_levels()).unsqueeze(0)
    levels = engine.settle(theta, engine.constant_guess(theta)).levels
    theta, _, near = fitter.descend(engine, theta, levels, 5)
    return subject.readings - engine.settle(theta, near.levels).readings[0]


def _first(mask: Tensor) -> Tensor:
    early = mask.clone()
    early[START_SAMPLES:] = False
    return early


def _closed(
    recalibrated: Tensor, augmented: Tensor, mask: Tensor, noise: Noise
) -> tuple[float | None, tuple[float, float] | None]:
    """The share closed and its 95 % interval over blocks of time; None where the gap is under 5 standard errors.

    The noise of the hold-out is the same in both runs, so that the gap is their difference, plus what the augmented
    run leaves; the latter counts as far as it stands out of the uncertainty of the floor.
    """
    difference, count = _blocks(recalibrated - augmented), float(mask.sum())
    excess = float((augmented - noise.std**2 * mask).sum())
    uncertain = math.sqrt(float((2.0 * noise.std**4 * mask.sum(dim=0) * (1 + noise.ar**2) / (1 - noise.ar**2)).sum()))
    left = math.copysign(max(abs(excess) - uncertain, 0.0), excess)
    total, error = float(difference.sum()) + max(left, 0.0), float(difference.std()) * math.sqrt(len(difference))
    if total < DEFINED * min(error, uncertain) or total <= 0.0 or count == 0.0:
        return None, None
    generator = torch.Generator().manual_seed(0)
    pick = torch.randint(len(difference), (DRAWS, len(difference)), generator=generator)
    rest = max(left, 0.0) + uncertain * torch.randn(DRAWS, generator=generator, dtype=difference.dtype)
    drawn = 1.0 - rest / (difference[pick].sum(dim=1) + rest.clamp(min=0.0)).clamp(min=1e-300)
    low, high = torch.quantile(drawn, torch.tensor([0.025, 0.975], dtype=drawn.dtype)).tolist()
    return 1.0 - max(left, 0.0) / total, (max(low, -9.0), min(high, 1.0))


def _blocks(x: Tensor) -> Tensor:
    """(S, C) -> sums over blocks of time."""
    return torch.stack([b.sum() for b in torch.tensor_split(x.sum(dim=1), BLOCKS)])
