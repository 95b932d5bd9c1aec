"""Step size control for lanes that divide the grid's steps individually, as accurately as a tolerance requires.

kernel.hpp has the same rules for single lanes; here they are tensors (L,). No lane depends on another one.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.scales import fastest_exchange, length_scale

# The error of a step over the kink of a square root grows with step^1.5, and so does that of a root smoothed for this
# step. It is 1 m for a step of this length, in units of the plant's fastest exchange of water and its length scale: the
# largest error of fixed steps over random faults of the three-tank plant.
STEP_FOR_ONE_METRE = 2000.0
# Steps across the kink, relative to the step for which the root is smoothed, that keep about the same accuracy.
CROSSING = 0.25
# Number of steps whose errors accumulate before the tanks' dynamics damp them.
ADDED_UP = 100.0
LONGER, SHORTER = 3.0, 0.1  # maximum and minimum ratio of successive steps


@dataclass(frozen=True)
class StepControl:
    """The accuracy of adaptive steps.

    tolerance: of a level's error per step, m. resolution: time scale of the smoothing of square roots and rims, s.
    shortest: minimum length of a step, s. slope_tolerance: error per step of a level's slope by a parameter, relative
    to that parameter's largest slope so far. At the kink of a root, the error of levels grows with step^1.5 and that of
    slopes with step^0.5, so that it is the cube root of the levels' tolerance.
    """

    tolerance: float
    resolution: float
    shortest: float
    slope_tolerance: float

    @classmethod
    def for_tolerance(cls, tolerance: float, plant: PlantDescription, resolution: float | None = None) -> StepControl:
        """Steps for a tolerance (m) of the whole simulation; `resolution` (s) overrides the smoothing that goes with
        it.

        Raises ValueError if the tolerance per step is not above the rounding error of the plant's levels.
        """
        scale, rounding = length_scale(plant), ADDED_UP * torch.finfo(torch.float64).eps
        if not tolerance > rounding * scale:
            raise ValueError(
                f"expected a tolerance above the rounding of levels ({rounding * scale:.2g} m after {ADDED_UP:g} "
                f"steps), got {tolerance:.2g} m; ask for steps of "
                f"{_step_of_unit_error(plant) * rounding ** (2.0 / 3.0):.2g} s or longer"
            )
        relative = tolerance / scale
        matching = _step_of_unit_error(plant) * relative ** (2.0 / 3.0)
        slope_tolerance = (relative / ADDED_UP) ** (1.0 / 3.0)
        return cls(tolerance / ADDED_UP, resolution or matching, CROSSING * matching, slope_tolerance)

    @classmethod
    def for_fixed_step(cls, step: float, plant: PlantDescription) -> StepControl:
        """Steps about as accurate as fixed ones of `step` s."""
        return cls.for_tolerance(length_scale(plant) * (step / _step_of_unit_error(plant)) ** 1.5, plant)


def _step_of_unit_error(plant: PlantDescription) -> float:
    """The step whose error is the plant's length scale, s."""
    return STEP_FOR_ONE_METRE * fastest_exchange(plant)


def next_step(elapsed: Float[Tensor, " L"], length: Float[Tensor, " L"], span: Tensor) -> Float[Tensor, " L"]:
    """Length of each lane's next step (L,), s, after `elapsed` s of `span`.

    The step is the lane's `length`, shortened so that no short step remains before the end; `span` for a finished lane.
    """
    remaining = span - elapsed
    step = torch.where(remaining <= length, remaining, torch.where(remaining < 2.0 * length, remaining / 2.0, length))
    return torch.where(remaining > 0.0, step, span)


def accept_steps(
    step: Float[Tensor, " L"],
    error: Float[Tensor, " L"],
    elapsed: Float[Tensor, " L"],
    length: Float[Tensor, " L"],
    span: Tensor,
    shortest: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Accept or reject a step of each lane (L,): the accepted lanes, the times they have reached, and their next
    lengths, s.

    step: length of the step taken; elapsed: time reached before it; length: the lane's planned length (a step may be
    shorter at the end of the span). error: relative to the tolerance; infinite for a step without a solution. A step is
    accepted if its error is at most 1, or if it is the shortest allowed. The next length follows from the error, which
    grows with step^4. Levels that are NaN are accepted unchanged.
    """
    cut = torch.sqrt(torch.sqrt(torch.nan_to_num(error, nan=0.0))) / 0.9
    proposed = step / torch.clamp(cut, 1.0 / LONGER, 1.0 / SHORTER)
    is_open, accurate = elapsed < span, ~(error > 1.0)
    next_length = torch.where(accurate & (step < length) & (proposed < length), length, proposed)
    accepted = is_open & (accurate | (step <= shortest))
    reached = torch.where(span - elapsed <= step, span, elapsed + step)
    return (
        accepted,
        torch.where(accepted, reached, elapsed),
        torch.where(is_open, torch.clamp(next_length, min=shortest), length),
    )
