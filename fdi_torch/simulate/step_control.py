"""Adaptive steps, in which each lane divides the grid's steps as a tolerance requires: their accuracy and coefficients.

kernel.hpp takes the steps, by the L-stable Runge-Kutta method of order 4 with an embedded error estimate
ARK4(3)6L[2]SA-ESDIRK of Kennedy and Carpenter (2003), "Additive Runge-Kutta schemes for convection-diffusion-reaction
equations", Appl. Numer. Math. 44: 139-181. Nearly equal levels equalise within milliseconds. That limits the steps of
an explicit method; the steps of an L-stable one are limited only by the actual rates of change.

Each stage is Y = r + g f(Y) with r = h + dt sum a_sj k_j and g = dt / 4, solved by Newton's method with the exact J =
df/dh. Its sensitivity to theta obeys (1 - g J) dY = dr + g df/dtheta, the exact derivative of the step.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

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

DIAGONAL = 0.25
STAGES: tuple[tuple[float, ...], ...] = (
    (0.25,),
    (8611 / 62500, -1743 / 31250),
    (5012029 / 34652500, -654441 / 2922500, 174375 / 388108),
    (15267082809 / 155376265600, -71443401 / 120774400, 730878875 / 902184768, 2285395 / 8070912),
    (82889 / 524892, 0.0, 15625 / 83664, 69875 / 102672, -2260 / 8211),
)
"""a_sj of the five implicit stages; the last one is the step itself."""
EMBEDDED = (
    4586570599 / 29645900160,
    0.0,
    178811875 / 945068544,
    814220225 / 1159782912,
    -3700637 / 11593932,
    61727 / 225920,
)
"""Weights of the embedded step of order 3, for the error estimate."""
ERROR = tuple(a - b for a, b in zip((*STAGES[-1], DIAGONAL), EMBEDDED, strict=True))

# Newton's method ends when the next correction, extrapolated from the last two, would be below this fraction of the
# step's tolerance, or when the last one was rounding error (in units of the level's last place).
NEWTON_SHARE, NEWTON_ROUNDING, NEWTON_ROUNDS = 1e-4, 8.0, 8


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
