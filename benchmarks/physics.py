"""The three tanks written by hand, as a user of another tool would write them; the same equations as the plant's.

`make_rates` takes the elementary functions, so that numba compiles it for numbers and JAX and torch for arrays.
Units are SI; theta: leak of T1, net outlet of T2, leak of T3, openness of P13 and of P32.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

AREA, HEIGHT, GRAVITY = 160e-4, 1.0, 9.81
CAPACITY = 0.6 * 0.6e-4 * math.sqrt(2 * GRAVITY)
INFLOW = 50e-6
START = (0.5899, 0.3933, 0.4916)
CREST = 2 / 3 * 0.6 * math.sqrt(2 * GRAVITY) * 2 * math.sqrt(math.pi * AREA)


def widths(resolution: float) -> tuple[float, float]:
    """Squared widths (m^2) over which the roots at pipes and at the outlet are smoothed, for steps of that length."""
    bound = CAPACITY / AREA * resolution / 2.2
    return (4 * bound * bound) ** 2, (bound * bound) ** 2


def make_rates(sqrt: Callable, maximum: Callable, where: Callable, jit: Callable = lambda f: f) -> Callable[..., Any]:
    """rates(three levels, five theta, pipe width^2, outlet width^2, resolution, two inflows) -> three dh/dt in m/s."""

    @jit
    def root(x, w2):  # type: ignore[no-untyped-def]
        return x / sqrt(sqrt(x * x + w2))

    @jit
    def spilled(h, q, resolution):  # type: ignore[no-untyped-def]
        above = maximum(h - HEIGHT, 0.0)
        edge = sqrt(above + 1e-9)
        stiff = maximum(1.5 * CREST * edge * resolution / AREA - 1.7, 0.0)
        q = q - maximum((CREST * above * edge + stiff * q) / (1.0 + stiff), 0.0)
        return where(h <= 0.0, maximum(q, 0.0), q) / AREA

    @jit
    def rates(h1, h2, h3, t1, t2, t3, t4, t5, w_pipe, w_outlet, resolution, q1=INFLOW, q2=INFLOW):  # type: ignore[no-untyped-def]
        q13 = t4 * CAPACITY * root(h1 - h3, w_pipe)
        q32 = t5 * CAPACITY * root(h3 - h2, w_pipe)
        out = t2 * CAPACITY * root(maximum(h2, 0.0), w_outlet)
        leak1 = t1 * CAPACITY * root(maximum(h1, 0.0), w_pipe)
        leak3 = t3 * CAPACITY * root(maximum(h3, 0.0), w_pipe)
        return (
            spilled(h1, q1 - q13 - leak1, resolution),
            spilled(h2, q2 + q32 - out, resolution),
            spilled(h3, q13 - q32 - leak3, resolution),
        )

    return rates


def make_step(rates: Callable[..., Any], jit: Callable = lambda f: f) -> Callable[..., Any]:
    """One RK4 step (3/8 rule): levels, theta, widths and the step's length -> levels."""

    @jit
    def step(h1, h2, h3, t1, t2, t3, t4, t5, wp, wo, dt, q1=INFLOW, q2=INFLOW):  # type: ignore[no-untyped-def]
        a1, a2, a3 = rates(h1, h2, h3, t1, t2, t3, t4, t5, wp, wo, dt, q1, q2)
        b1, b2, b3 = rates(h1 + dt * a1 / 3, h2 + dt * a2 / 3, h3 + dt * a3 / 3, t1, t2, t3, t4, t5, wp, wo, dt, q1, q2)
        c1, c2, c3 = rates(
            h1 + dt * (b1 - a1 / 3), h2 + dt * (b2 - a2 / 3), h3 + dt * (b3 - a3 / 3),
            t1, t2, t3, t4, t5, wp, wo, dt, q1, q2,
        )  # fmt: skip
        d1, d2, d3 = rates(
            h1 + dt * (a1 - b1 + c1), h2 + dt * (a2 - b2 + c2), h3 + dt * (a3 - b3 + c3),
            t1, t2, t3, t4, t5, wp, wo, dt, q1, q2,
        )  # fmt: skip
        e = dt / 8
        return (
            h1 + e * (a1 + 3 * (b1 + c1) + d1),
            h2 + e * (a2 + 3 * (b2 + c2) + d2),
            h3 + e * (a3 + 3 * (b3 + c3) + d3),
        )

    return step
