"""Steps of each lane's own within a step of the grid, as long as their error allows: the control that chooses them.

The same rules stand in kernel.hpp, lane by lane; here they are tensors (L,). A lane never looks at another's numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.pace import length_scale, time_scale

# RK4 is stable on the real axis down to -2.785; a step is kept below the one and chosen for the other.
STABLE, CALM = 2.6, 2.2
# A step over a root's kink is wrong by step^1.5, and so is a root drawn smooth for that step: by 1 m for one so long,
# in units of the plant's time and length scales. From the largest error of fixed steps over random faults of three
# tanks.
STEP_FOR_ONE_METRE = 2000.0


@dataclass(frozen=True)
class OwnSteps:
    """How exactly lanes divide the time by themselves.

    tolerance, m: of a level's error over a step; at 1e-6 m and less, over random faults of three tanks, the largest
    error of a whole simulation was 1.5 to 2 times this. shortest, s: the shortest step that a lane may take.
    """

    tolerance: float
    shortest: float

    @classmethod
    def within(cls, tolerance: float, plant: PlantDescription) -> OwnSteps:
        """Steps for a tolerance (m). Raises ValueError unless it is positive."""
        if not tolerance > 0:
            raise ValueError(f"expected a positive tolerance, got {tolerance} m")
        return cls(tolerance, _step_of_unit_error(plant) * (tolerance / length_scale(plant)) ** (2.0 / 3.0))

    @classmethod
    def like(cls, step: float, plant: PlantDescription) -> OwnSteps:
        """Steps about as exact as fixed ones of `step` s."""
        return cls.within(length_scale(plant) * (step / _step_of_unit_error(plant)) ** 1.5, plant)


def _step_of_unit_error(plant: PlantDescription) -> float:
    """The step, s, whose error is the plant's length scale."""
    return STEP_FOR_ONE_METRE * time_scale(plant)


def own_step(gone: Tensor, pace: Tensor, span: Tensor) -> Tensor:
    """How far each lane (L,) goes next, s, after `gone` s of `span`: as far as its pace, not leaving a short step over;
    `span` where it is there.
    """
    rest = span - gone
    own = torch.where(rest <= pace, rest, torch.where(rest < 2.0 * pace, rest / 2.0, pace))
    return torch.where(rest > 0.0, own, span)


def judged(
    own: Tensor,
    error: Tensor,
    stiffness: Tensor,
    gone: Tensor,
    pace: Tensor,
    span: Tensor,
    tolerance: float,
    shortest: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Which lanes keep the step they took (L,), how far they have come and their pace from here on, s.

    A step is kept where its error (m) is small and it is stable beside the stiffness (1/s), or where it is as short as
    they come. The next one's length follows from the error, which grows with step^3, or at a root's kink with
    step^1.5, and from the stiffness: the error alone would let steps waver about the limit of stability, where levels
    at rest stay as they are and their slopes grow.
    """
    ratio = tolerance / (torch.nan_to_num(error, nan=0.0) + tolerance * 1e-6)
    cut = torch.sqrt(ratio)
    longer, shorter = torch.clamp(0.9 * torch.sqrt(cut), max=3.0), torch.where(cut < 0.05, 0.05, 0.9 * cut)
    is_open, small = gone < span, (ratio >= 1.0) & ~(own * stiffness > STABLE)
    reach, stable = own * torch.where(small, longer, shorter), CALM / stiffness
    wanted = torch.where(small & (own < pace) & (reach < pace), pace, reach)
    following = torch.where(stable < wanted, stable, wanted)
    kept = is_open & (small | (own <= shortest))
    after = torch.where(span - gone <= own, span, gone + own)
    return (
        kept,
        torch.where(kept, after, gone),
        torch.where(is_open, torch.where(following < shortest, shortest, following), pace),
    )
