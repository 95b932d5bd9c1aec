"""Torricelli's law through an orifice, regularised so that it has finite slope everywhere."""

from __future__ import annotations

import math

import torch
from torch import Tensor

# RK4 is stable on the real axis down to -2.785. Errors over random faults were least with roots at this rate x step,
# and rims at that one: enough below the limit for several orifices on one tank.
STABLE_RATE_TIMES_STEP = 2.2
STABLE_SPILL_TIMES_STEP = 1.7
EMPTYING_RATE_TIMES_STEP = 2.0
WEIR_COEFFICIENT = 0.6
_DRY = 1e-9  # m; keeps the weir's slope finite where nothing runs over it


def signed_root(head: Tensor, width: Tensor) -> Tensor:
    """sgn(x) sqrt(|x|), smooth within `width` (m) of zero: x / (x^2 + w^2)^(1/4).

    The slope at zero is 1/sqrt(w); for |x| >> w the relative error is (w/x)^2 / 4.
    """
    return head / torch.sqrt(torch.sqrt(head * head + width * width))


def regular_width(rate: float, resolution: Tensor) -> Tensor:
    """The width (m) at which the levels' fastest rate, `rate` / sqrt(w), suits a step of `resolution` (s).

    rate = C_d a sqrt(2 g) (1/A_1 + 1/A_2), in m^0.5/s.
    """
    bound = rate * resolution / STABLE_RATE_TIMES_STEP
    return bound * bound


def orifice_capacity(discharge_coefficient: Tensor, area: Tensor, gravity: Tensor) -> Tensor:
    """C_d a sqrt(2 g): the flow at 1 m of head, m^2.5/s (Torricelli)."""
    return discharge_coefficient * area * torch.sqrt(2.0 * gravity)


def rim_strength(tank_area: Tensor, gravity: Tensor) -> Tensor:
    """(2/3) C sqrt(2 g) 2 sqrt(pi A): the flow over the whole rim of a round tank at 1 m above it, m^1.5/s.

    A sharp-crested weir as long as the rim; x^(3/2) of it at x m.
    """
    crest = 2.0 * torch.sqrt(math.pi * tank_area)
    return (2.0 / 3.0) * WEIR_COEFFICIENT * torch.sqrt(2.0 * gravity) * crest


def held(rate: Tensor, level: Tensor, resolution: Tensor) -> Tensor:
    """dh/dt (m/s) of a tank at `level` m that would change by `rate`: one that runs dry stays at its floor.

    What draws at an empty tank (a drain whose end lies lower, evaporation) would have the rate jump there, where no
    step ends: so the last of the level goes no faster than 2 / r of it, r = `resolution` s. The implicit midpoint rule
    then ends a step of r at the floor, and RK4 is stable.
    """
    # At the floor itself without a slope: a guess that it is dry gives way at once to water that comes after all.
    slowest = torch.where(level > 0.0, -EMPTYING_RATE_TIMES_STEP * level / resolution, 0.0)
    return torch.maximum(rate, slowest)


def weir_flow(
    excess: Tensor, inflow: Tensor | float, tank_area: Tensor, strength: Tensor, resolution: Tensor
) -> Tensor:
    """What runs over a rim (or a share of it) of that strength at `excess` m above it while `inflow` m^3/s comes in.

    w(x) = strength x^(3/2), m^3/s. It is far faster than the tank: where w'(x) r / A is too large for a step of
    r = `resolution` s, it is taken linearly implicitly for the excess a of that number (Rosenbrock 1963),
    (w + a q) / (1 + a). At rest this is w = q exactly, at any step.
    """
    above = torch.clamp(excess, min=0.0)
    root = torch.sqrt(above + _DRY)
    stiffness = torch.clamp(1.5 * strength * root * resolution / tank_area - STABLE_SPILL_TIMES_STEP, min=0.0)
    spill = torch.clamp((strength * above * root + stiffness * inflow) / (1.0 + stiffness), min=0.0)
    return torch.where(excess > 0.0, spill, 0.0)
