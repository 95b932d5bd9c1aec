"""What the first stretch of a run tells of it: start levels, what varies from run to run, and the levels at its end.

A plant's equations are wrong by more than its sensors' noise, and for long: were what they miss taken for noise, a hose
or a zero would be bent until it made good for it. So water may come and go unseen while the plant settles, a constant
flow into each tank for each part of the stretch. How much of it there may be, as a share of what runs out of a full
tank, is told by the stretch itself: the size is taken under which its readings are likeliest (the evidence, MacKay
1992, by Laplace's approximation). After the stretch there is none, and the levels go on from where it led them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import torch
from torch import Tensor

from fdi_torch.gap.candidate_fit import Candidate, Fit, Fitter
from fdi_torch.gap.dataset import DataSet
from fdi_torch.gap.noise_model import Noise
from fdi_torch.parameters import Parameter
from fdi_torch.plant.constants import flow_scale, reading_span
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Effect, Local, Placement, Stage, Values

PARTS = 8  # of the stretch
SHARES = (1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3)  # of what runs out of a full tank
FINEST, COARSEST = 1e-5, 1e-2  # of what a sensor reads from floor to rim: its noise lies between


class UnseenFlow(Effect):
    """A constant inflow during each part of the stretch, normal about none; none after it."""

    name = "unseen_flow"
    stage = Stage.BALANCE
    places: ClassVar[tuple[str, ...]] = ("tank",)

    def __init__(self, seconds: float, parts: int, share: float) -> None:
        self.edges = [seconds * j / parts for j in range(parts + 1)]
        self.share = share

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        std = self.share * flow_scale(plant, place)
        return tuple(Parameter(f"flow_{j}", "m^3/s", 0.0, std=std) for j in range(len(self.edges) - 1))

    def inflow(self, local: Local, p: Values) -> Tensor:
        after = [local.clock.share_after(local.clock.start.new_tensor(edge)) for edge in self.edges]
        total = torch.zeros_like(after[0])
        for j, (begun, ended) in enumerate(pairwise(after)):
            total = total + p[f"flow_{j}"] * (begun - ended)
        return total


@dataclass(frozen=True)
class InitialStateFit:
    """placements: what came and went unseen. values: by name, those of its flows among them, SI."""

    placements: tuple[Placement, ...]
    values: Mapping[str, float]


def estimate_initial_state(stretch: DataSet, starts: Sequence[Mapping[str, float]], rough: Noise) -> InitialStateFit:
    """stretch: the beginning of a recording, all of whose readings are used; what its plant has a tolerance for is
    fitted. starts: of the start levels, m. rough: what the sensors' noise is taken for until the stretch has told it.
    """
    plant, seconds = stretch.plant, float(stretch.experiment.nodes[-1])
    parts = max(1, min(PARTS, len(stretch.recording) // 2))
    fitter = Fitter(stretch, rough)
    plain = fitter.fit(Candidate(starts=tuple(starts)))
    fitter = Fitter(stretch, _fine_noise(stretch, plain))
    best = fitter.fit(Candidate(), plain)
    bent = {n: best.values[n] for n in plant.varying}
    believed = {n: best.space[n].nominal for n in plant.varying}
    likeliest = _surprise(fitter, best)
    for share in SHARES:
        unseen = UnseenFlow(seconds, parts, share)
        placements = tuple(Placement(unseen, tank.name) for tank in plant.tanks)
        none = {f"{p.prefix}.{q.name}": 0.0 for p in placements for q in unseen.parameters(p.location, plant)}
        # What varies was bent as far as it goes where nothing flowed unseen: it also begins at what is believed.
        both = tuple(none | varying for varying in (bent, believed))
        fit = fitter.fit(Candidate(placements, both), plain)
        if (found := _surprise(fitter, fit)) < likeliest:
            best, likeliest = fit, found
    return InitialStateFit(best.candidate.placements, best.values)


def _surprise(fitter: Fitter, fit: Fit) -> float:
    """Twice the negative logarithm of the evidence, but for what all fits of the stretch have in common."""
    scale = fitter.box(fit.space)[2]
    _, _, curvature = fitter.normal(fit.space, fit.theta.unsqueeze(0), fit.linearised, scale)
    found = fit.cost + float(torch.logdet(curvature[0]))
    return found if math.isfinite(found) else math.inf


def _fine_noise(stretch: DataSet, fit: Fit) -> Noise:
    """White, told by how far of three residuals in a row the second lies from between its neighbours: what of a model's
    error is as fast counts as noise. (Not by the median: a sensor of coarse steps stands still most of the time.)
    """
    span = torch.tensor([reading_span(stretch.plant, s) for s in stretch.plant.sensors], dtype=torch.float64)
    left, size = stretch.readings - fit.linearised.readings[0], COARSEST * span
    seen = stretch.mask[2:] & stretch.mask[1:-1] & stretch.mask[:-2]
    off = (left[2:] - 2.0 * left[1:-1] + left[:-2]) / math.sqrt(6.0)
    for c in seen.any(dim=0).nonzero().flatten().tolist():
        size[c] = off[seen[:, c], c].square().mean().sqrt()
    return Noise(torch.minimum(torch.maximum(size, FINEST * span), COARSEST * span), torch.zeros_like(span))
