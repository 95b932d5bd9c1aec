"""Initial state of a free run, estimated from an initial segment of the recording.

The segment determines the initial levels, the constants that vary between recordings, and the levels at its end. A
plant's equations are wrong by more than the sensor noise, and for longer; without allowance for it, a varying constant
would be biased until it compensated the error. Each tank therefore has an unknown constant inflow in each part of the
segment, normal about zero. Its standard deviation, as a share of the outflow of a full tank, maximises the evidence
(MacKay, 1992; Laplace's approximation). After the segment this inflow is zero.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import torch
from torch import Tensor

from fdi_torch.gap.candidate import Candidate, Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.channel_noise import Noise
from fdi_torch.gap.dataset import DataSet
from fdi_torch.parameters import Parameter
from fdi_torch.plant.constants import flow_scale, reading_span
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Effect, Local, Placement, Stage, Values

SEGMENT_PARTS = 8  # parts of the segment
INFLOW_SHARES = (1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3)  # inflow over the outflow of a full tank
MIN_NOISE, MAX_NOISE = 1e-5, 1e-2  # bounds of the noise, as shares of the sensor's span


class UnknownInflow(Effect):
    """An unknown inflow, constant during each part of the segment and zero after it; its prior is normal about zero."""

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
    """placements: the unknown inflows. values: fitted values by name, SI, those of the inflows included."""

    placements: tuple[Placement, ...]
    values: Mapping[str, float]


def estimate_initial_state(segment: DataSet, starts: Sequence[Mapping[str, float]], rough: Noise) -> InitialStateFit:
    """Fit the initial state to the beginning of a recording, with all that has a tolerance.

    starts: of the initial levels, m. rough: sensor noise of the first fit, from which the noise is then estimated.
    """
    plant, seconds = segment.plant, float(segment.experiment.nodes[-1])
    parts = max(1, min(SEGMENT_PARTS, len(segment.recording) // 2))
    fitter = Fitter(segment, rough)
    plain = fitter.fit(Candidate(starts=tuple(starts)))
    fitter = Fitter(segment, _fine_noise(segment, plain))
    best = fitter.fit(Candidate(), plain)
    fitted_values = {n: best.values[n] for n in plant.varying}
    nominal = {n: best.space[n].nominal for n in plant.varying}
    lowest = _negative_log_evidence(fitter, best)
    for share in INFLOW_SHARES:
        inflow = UnknownInflow(seconds, parts, share)
        placements = tuple(Placement(inflow, tank.name) for tank in plant.tanks)
        zero = {p.full_name(q.name): 0.0 for p in placements for q in inflow.parameters(p.location, plant)}
        # Without inflows, varying constants may have gone to a bound; so they also start at nominal.
        both_starts = tuple(zero | varying for varying in (fitted_values, nominal))
        fit = fitter.fit(Candidate(placements, both_starts), plain)
        if (value := _negative_log_evidence(fitter, fit)) < lowest:
            best, lowest = fit, value
    return InitialStateFit(best.candidate.placements, best.values)


def _negative_log_evidence(fitter: Fitter, fit: Fit) -> float:
    """Twice the negative log evidence, without terms that all fits of the segment share.

    A parameter without a tolerance has the information of a uniform prior over its range, 12 / width^2, since the
    readings may not show it, such as the level of a tank below all sensors.
    """
    low, high, scale = fitter.box(fit.space)
    uniform = torch.where(torch.isinf(fit.space.std(fit.theta)), 12.0 * (scale / (high - low)) ** 2, 0.0)
    value = fit.cost + float(torch.logdet(fitter.curvature(fit) + torch.diag(uniform)))
    return value if math.isfinite(value) else math.inf


def _fine_noise(segment: DataSet, fit: Fit) -> Noise:
    """White noise, estimated from second differences of the residual; fast model errors count as noise.

    The median is not used, since a sensor with coarse steps has equal readings most of the time.
    """
    span = torch.tensor([reading_span(segment.plant, s) for s in segment.plant.sensors], dtype=torch.float64)
    residual, size = segment.readings - fit.linearised.readings[0], MAX_NOISE * span
    valid = segment.mask[2:] & segment.mask[1:-1] & segment.mask[:-2]
    differences = (residual[2:] - 2.0 * residual[1:-1] + residual[:-2]) / math.sqrt(6.0)
    for c in valid.any(dim=0).nonzero().flatten().tolist():
        size[c] = differences[valid[:, c], c].square().mean().sqrt()
    return Noise.white(torch.minimum(torch.maximum(size, MIN_NOISE * span), MAX_NOISE * span))
