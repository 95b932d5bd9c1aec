"""Outflow laws: Torricelli's law with finite slope at zero head, overflow over a rim, and a tank that runs empty."""

from __future__ import annotations

import math

import torch
from torch import Tensor

# Stability of explicit RK4 on the real axis requires |rate x step| < 2.785. These values had the least error over
# random faults; they leave a margin for several orifices on one tank.
STABLE_RATE_TIMES_STEP = 2.2
STABLE_SPILL_TIMES_STEP = 1.7
EMPTYING_RATE_TIMES_STEP = 2.0
WEIR_COEFFICIENT = 0.6
_DRY = 1e-9  # m; keeps the weir's slope finite at zero excess


def signed_root(head: Tensor, width: Tensor) -> Tensor:
    """sgn(x) sqrt(|x|), smooth within `width` (m) of zero: x / (x^2 + w^2)^(1/4).

    The slope at zero is 1/sqrt(w); for |x| >> w the relative error is (w/x)^2 / 4.
    """
    return head / torch.sqrt(torch.sqrt(head * head + width * width))


def regular_width(rate: float, resolution: Tensor) -> Tensor:
    """Smoothing width w (m) at which the levels' fastest rate, `rate` / sqrt(w), is stable at a step `resolution` (s).

    rate = C_d a sqrt(2 g) (1/A_1 + 1/A_2), in m^0.5/s.
    """
    bound = rate * resolution / STABLE_RATE_TIMES_STEP
    return bound * bound


def orifice_capacity(discharge_coefficient: Tensor, area: Tensor, gravity: Tensor) -> Tensor:
    """C_d a sqrt(2 g): flow at 1 m of head, m^2.5/s (Torricelli)."""
    return discharge_coefficient * area * torch.sqrt(2.0 * gravity)


def rim_strength(tank_area: Tensor, gravity: Tensor) -> Tensor:
    """Weir coefficient of a round tank's rim: (2/3) C sqrt(2 g) 2 sqrt(pi A), m^1.5/s.

    The rim is a sharp-crested weir of length 2 sqrt(pi A); its overflow at x m above it is this times x^(3/2), m^3/s.
    """
    crest = 2.0 * torch.sqrt(math.pi * tank_area)
    return (2.0 / 3.0) * WEIR_COEFFICIENT * torch.sqrt(2.0 * gravity) * crest


def limit_emptying(rate: Tensor, level: Tensor, resolution: Tensor) -> Tensor:
    """Limit dh/dt (m/s) from below so that a tank never falls below its floor: max(rate, -2 h / r).

    A drain that ends below the floor, or evaporation, would make the rate jump at level 0 within a step. With
    r = `resolution` (s), an implicit midpoint step of r ends at the floor, and RK4 is stable.
    """
    # No slope at the floor itself: otherwise an iteration that starts from an empty tank could not leave it at once.
    slowest = torch.where(level > 0.0, -EMPTYING_RATE_TIMES_STEP * level / resolution, 0.0)
    return torch.maximum(rate, slowest)


def weir_flow(
    excess: Tensor, inflow: Tensor | float, tank_area: Tensor, strength: Tensor, resolution: Tensor
) -> Tensor:
    """Flow over a rim, or over a share of it, m^3/s.

    w(x) = strength x^(3/2) at the excess x = `excess` (m) above the rim, while `inflow` (m^3/s) enters the tank. This
    is much faster than the tank itself. Where the number w'(x) r / A exceeds its stable limit by a > 0, with r =
    `resolution` (s), the flow is taken linearly implicitly (Rosenbrock, 1963): (w + a q) / (1 + a). The steady state is
    w = q for every step.
    """
    above = torch.clamp(excess, min=0.0)
    root = torch.sqrt(above + _DRY)
    stiffness = torch.clamp(1.5 * strength * root * resolution / tank_area - STABLE_SPILL_TIMES_STEP, min=0.0)
    spill = torch.clamp((strength * above * root + stiffness * inflow) / (1.0 + stiffness), min=0.0)
    return torch.where(excess > 0.0, spill, 0.0)
