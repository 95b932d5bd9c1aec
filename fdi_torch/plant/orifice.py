"""Outflow laws: Torricelli's law with finite slope at zero head, overflow over a rim, and a tank that runs empty."""

from __future__ import annotations

import math

import torch

# Stability of explicit RK4 on the real axis requires |rate x step| < 2.785. These values had the least error over
# random faults; they leave a margin for several orifices on one tank.
STABLE_RATE_TIMES_STEP = 2.2
STABLE_SPILL_TIMES_STEP = 1.7
EMPTYING_RATE_TIMES_STEP = 2.0
WEIR_COEFFICIENT = 0.6
_DRY = 1e-9  # m; keeps the weir's slope finite at zero excess
_ROUNDING = 1e-15  # m; change of a level in a step of the resolution, far above rounding errors


def signed_root(head: torch.Tensor, width: torch.Tensor) -> torch.Tensor:
    """sgn(x) sqrt(|x|), smooth within `width` (m) of zero: x / (x^2 + w^2)^(1/4).

    The slope at zero is 1/sqrt(w); for |x| >> w the relative error is (w/x)^2 / 4.
    """
    return head / torch.sqrt(torch.sqrt(head * head + width * width))


def regular_width(rate: float, resolution: torch.Tensor) -> torch.Tensor:
    """Smoothing width w (m) at which the levels' fastest rate, `rate` / sqrt(w), is stable at a step `resolution` (s).

    rate = C_d a sqrt(2 g) (1/A_1 + 1/A_2), in m^0.5/s.
    """
    bound = rate * resolution / STABLE_RATE_TIMES_STEP
    return bound * bound


def weir_strength(coefficient: torch.Tensor | float, crest: torch.Tensor, gravity: torch.Tensor) -> torch.Tensor:
    """Weir coefficient (2/3) C sqrt(2 g) b of a sharp crest of length b, m^1.5/s; flow over it at 1 m above the crest.

    Rectangular weir (Poleni, 1717; Bos, 1989, "Discharge Measurement Structures", ch. 5); C is about 0.6.
    """
    return (2.0 / 3.0) * coefficient * torch.sqrt(2.0 * gravity) * crest


def rim_strength(tank_area: torch.Tensor, gravity: torch.Tensor) -> torch.Tensor:
    """Weir coefficient of a round tank's rim, a crest of length 2 sqrt(pi A), m^1.5/s."""
    return weir_strength(WEIR_COEFFICIENT, 2.0 * torch.sqrt(math.pi * tank_area), gravity)


def limit_emptying(rate: torch.Tensor, level: torch.Tensor, resolution: torch.Tensor) -> torch.Tensor:
    """Limit dh/dt (m/s) from below so that a tank never falls below its floor: max(rate, -2 h / r).

    A drain that ends below the floor, or evaporation, would make the rate jump at level 0 within a step. With
    r = `resolution` (s), an implicit midpoint step of r ends at the floor, and RK4 is stable.
    """
    # No slope at the floor itself: otherwise an iteration that starts from an empty tank could not leave it at once.
    slowest = torch.where(level > 0.0, -EMPTYING_RATE_TIMES_STEP * level / resolution, 0.0)
    # At rest on the floor both are zero but for rounding errors, which must not choose between their slopes.
    return torch.where(rate < slowest - _ROUNDING / resolution, slowest, rate)


def weir_law(excess: torch.Tensor, strength: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Flow over a crest w(x) = strength x^(3/2), m^3/s, and its slope w'(x), m^2/s, at the excess x (m) above it."""
    above = torch.clamp(excess, min=0.0)
    root = torch.sqrt(above + _DRY)
    return strength * above * root, 1.5 * strength * root


def weir_slope(flow: torch.Tensor, excess: torch.Tensor) -> torch.Tensor:
    """The slope 1.5 w / x of a flow over a crest (m^3/s) that effects have changed, at the excess x (m), m^2/s."""
    return 1.5 * flow / (torch.clamp(excess, min=0.0) + _DRY)


def limit_spill(
    flow: torch.Tensor,
    slope: torch.Tensor,
    *,
    excess: torch.Tensor,
    inflow: torch.Tensor | float,
    tank_area: torch.Tensor,
    resolution: torch.Tensor,
) -> torch.Tensor:
    """Flow over a crest (m^3/s), limited so that the tank is stable at a step of `resolution` (s).

    w = flow: the flow by the law at this excess (m), the level's height above the crest. w' = slope (m^2/s): its
    derivative by the excess. q = inflow (m^3/s): net inflow of the tank without this flow. r = resolution (s).

    The overflow brings the level back with the time constant A / w', which may be shorter than a step of an explicit
    method allows. With a = w' r / A - STABLE_SPILL_TIMES_STEP, the flow is w where a <= 0, and else
    (w + a q) / (1 + a), one step of a linearly implicit method (Rosenbrock, 1963). In steady state both are w = q,
    whatever the step.
    """
    stiffness = torch.clamp(slope * resolution / tank_area - STABLE_SPILL_TIMES_STEP, min=0.0)
    spill = torch.clamp((flow + stiffness * inflow) / (1.0 + stiffness), min=0.0)
    return torch.where(excess > 0.0, spill, 0.0)


def weir_flow(
    excess: torch.Tensor,
    inflow: torch.Tensor | float,
    tank_area: torch.Tensor,
    strength: torch.Tensor,
    resolution: torch.Tensor,
) -> torch.Tensor:
    """Flow over a rim, or over a share of it, m^3/s: `weir_law` limited by `limit_spill`."""
    flow, slope = weir_law(excess, strength)
    return limit_spill(flow, slope, excess=excess, inflow=inflow, tank_area=tank_area, resolution=resolution)


def limit_draw(
    flow: torch.Tensor, level: torch.Tensor, inflow: torch.Tensor, tank_area: torch.Tensor, resolution: torch.Tensor
) -> torch.Tensor:
    """A flow drawn from a tank (m^3/s), limited to what the tank holds and receives: min(flow, max(q + 2 A h / r, 0)).

    q = `inflow` (m^3/s): net inflow of the tank without this flow; r = `resolution` (s). The level then never falls
    faster than `limit_emptying` allows, so that the target receives what the source loses, and a dry tank passes on
    exactly its inflow.
    """
    available = torch.clamp(inflow + EMPTYING_RATE_TIMES_STEP * tank_area * level / resolution, min=0.0)
    return torch.where(available < flow - _ROUNDING * tank_area / resolution, available, flow)
