"""Steps of each lane's own within a step of the grid, as long as their error allows: the control that chooses them.

The same rules stand in kernel.hpp, lane by lane; here they are tensors (L,). A lane never looks at another's numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.scales import length_scale, time_scale

# A step over a root's kink is wrong by step^1.5, and so is a root drawn smooth for that step: by 1 m for one so long,
# in units of the plant's time and length scales. From the largest error of fixed steps over random faults of three
# tanks.
STEP_FOR_ONE_METRE = 2000.0
# The steps that cross the kink of a root, as a share of the one that it is drawn smooth for, are about as exact.
CROSSING = 0.25
# Errors of that many steps add up before the tanks have forgotten them.
ADDED_UP = 100.0
LONGER, SHORTER = 3.0, 0.1  # how much the next step may differ from the one before


@dataclass(frozen=True)
class OwnSteps:
    """How exactly lanes divide the time by themselves.

    tolerance, m: of a level's error over a step. resolution, s: roots and rims are drawn smooth for so long a step.
    shortest, s: the shortest step that a lane may take.
    slope_tolerance: of the error of a level's slope by a parameter over a step, as a share of that parameter's largest
    slope so far. A root's kink costs levels step^1.5 and slopes step^0.5, so that it is the cube root of the levels'.
    """

    tolerance: float
    resolution: float
    shortest: float
    slope_tolerance: float

    @classmethod
    def within(cls, tolerance: float, plant: PlantDescription, resolution: float | None = None) -> OwnSteps:
        """Steps for a tolerance (m) of the whole simulation. Roots are as sharp as that asks for, or `resolution` (s).

        Raises ValueError where a step's share of the tolerance is not above the rounding of the plant's levels.
        """
        scale, rounding = length_scale(plant), ADDED_UP * torch.finfo(torch.float64).eps
        if not tolerance > rounding * scale:
            raise ValueError(
                f"expected a tolerance above the rounding of levels ({rounding * scale:.2g} m after {ADDED_UP:g} "
                f"steps), got {tolerance:.2g} m; ask for steps of "
                f"{_step_of_unit_error(plant) * rounding ** (2.0 / 3.0):.2g} s or longer"
            )
        share = tolerance / scale
        as_sharp = _step_of_unit_error(plant) * share ** (2.0 / 3.0)
        slope_tolerance = (share / ADDED_UP) ** (1.0 / 3.0)
        return cls(tolerance / ADDED_UP, resolution or as_sharp, CROSSING * as_sharp, slope_tolerance)

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
    own: Tensor, error: Tensor, gone: Tensor, pace: Tensor, span: Tensor, shortest: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Which lanes keep the step they took (L,), how far they have come and their pace from here on, s.

    error: as a share of what is tolerated; infinite where a step has no solution. A step is kept where it is at most 1,
    or where the step is as short as they come. The next one's length follows from the error, which grows with step^4.
    An error of no number says nothing: levels of no number are kept as they are.
    """
    cut = torch.sqrt(torch.sqrt(torch.nan_to_num(error, nan=0.0))) / 0.9
    reach = own / torch.clamp(cut, 1.0 / LONGER, 1.0 / SHORTER)
    is_open, small = gone < span, ~(error > 1.0)
    following = torch.where(small & (own < pace) & (reach < pace), pace, reach)
    kept = is_open & (small | (own <= shortest))
    after = torch.where(span - gone <= own, span, gone + own)
    return (
        kept,
        torch.where(kept, after, gone),
        torch.where(is_open, torch.clamp(following, min=shortest), pace),
    )
