"""Laws of deviations at the hidden rigs' pumps: maps of the requested flow to the delivered flow.

A law is f(q, now, p, state) -> (q, state): q (n,) m^3/s, p its numbers (n,) each, state None at the first step and
always for a law without memory. A flow that changes within a step is given as its mean over the step.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from fdi_torch.blind.deviation import Array, Moment, Numbers

Delivered = tuple[Array, Any]


def late_and_slow(q: Array, now: Moment, p: Numbers, state: Any) -> Delivered:
    """Delay, and a first-order valve with a fifth of the delay as time constant."""
    return slow(now.asked(0.8 * p["delay"]), now, {"tau": 0.2 * p["delay"]}, state)


def rounded_limit(q: Array, now: Moment, p: Numbers, state: Any) -> Delivered:
    """q / (1 + (q/q_max)^16)^(1/16), computed by squaring and square roots."""
    x = q / p["limit"]
    for _ in range(4):
        x = x * x
    x = 1 + x
    for _ in range(4):
        x = np.sqrt(x)
    return q / x, None


def _pole(x: Array, old: Array, tau: Array, dt: float) -> Array:
    """Trapezoidal rule for tau y' = x - y."""
    a = 0.5 * dt / tau
    return (old * (1 - a) + 2 * a * x) / (1 + a)


def slow(q: Array, now: Moment, p: Numbers, state: Any) -> Delivered:
    """First-order lag."""
    old = q if state is None else state
    new = _pole(q, old, p["tau"], now.dt)
    return 0.5 * (old + new), new


def slow_in_two_poles(q: Array, now: Moment, p: Numbers, state: Any) -> Delivered:
    """Second-order lag: poles at 94 % and 6 % of the time constant."""
    fast, rotor = (q, q) if state is None else state
    fast_new = _pole(q, fast, 0.06 * p["tau"], now.dt)
    rotor_new = _pole(0.5 * (fast + fast_new), rotor, 0.94 * p["tau"], now.dt)
    return 0.5 * (rotor + rotor_new), (fast_new, rotor_new)


def backlash(q: Array, now: Moment, p: Numbers, state: Any) -> Delivered:
    """The play operator: backlash between command and spindle."""
    old = q - p["slack"] if state is None else state
    new = np.minimum(np.maximum(old, q - p["slack"]), q + p["slack"])
    return np.maximum(new, 0.0), new


def sticking(q: Array, now: Moment, p: Numbers, state: Any) -> Delivered:
    """A drive that does not respond to small changes of its command."""
    old = q if state is None else state
    new = np.where(np.abs(q - old) > p["stiction"], q, old)
    return new, new


def tiring(q: Array, now: Moment, p: Numbers, state: Any) -> Delivered:
    """A motor that delivers less when recent work has heated it."""
    heat = q / p["rated"] if state is None else state
    delivered = q * (1 - p["loss"] * heat)
    return delivered, heat + now.dt / p["tau"] * ((q / p["rated"]) ** 2 - heat)


def stalling(q: Array, now: Moment, p: Numbers, state: Any) -> Delivered:
    """Airlocks: three intervals in every `period` with partial delivery."""
    phase = np.mod(now.time / p["period"], 1.0)
    stalled = ((phase > 0.11) & (phase < 0.19)) | ((phase > 0.40) & (phase < 0.44)) | ((phase > 0.71) & (phase < 0.83))
    return np.where(stalled, p["rest"] * q, q), None


def sputtering(q: Array, now: Moment, p: Numbers, state: Any) -> Delivered:
    """Air intake for about a quarter of the time at aperiodic intervals: two sines of incommensurate periods."""
    turns = 2 * np.pi * now.time
    on = np.sin(turns / p["period"]) + np.sin(turns / (0.618 * p["period"]) + 1.0) > 0.9
    return np.where(on, p["rest"] * q, q), None


def slewing(q: Array, now: Moment, p: Numbers, state: Any) -> Delivered:
    """Rate limit of the flow, m^3/s per second."""
    old = q if state is None else state
    most = p["rate"] * now.dt
    new = old + np.minimum(np.maximum(q - old, -most), most)
    return 0.5 * (old + new), new


def soft_threshold(q: Array, now: Moment, p: Numbers, state: Any) -> Delivered:
    """A dead zone whose knee is a hyperbola: (x + sqrt(x^2 + w^2)) / 2 with x = q - d."""
    x = q - p["zone"]
    return np.where(q > 0, 0.5 * (x + np.sqrt(x * x + p["knee"] ** 2)), 0.0), None


# In the order in which they act: what replaces the command comes first.
PUMP_LAWS: dict[str, Callable[[Array, Moment, Numbers, Any], Delivered]] = {
    "late": lambda q, now, p, state: (now.asked(p["delay"]), None),  # plug flow in a hose
    # With some mixing: half arrives a little earlier, half a little later.
    "late_and_smeared": lambda q, now, p, state: (
        0.5 * (now.asked(0.92 * p["delay"]) + now.asked(1.08 * p["delay"])),
        None,
    ),
    "late_and_slow": late_and_slow,
    "slewing": slewing,
    "sticking": sticking,
    "backlash": backlash,
    "soft_threshold": soft_threshold,
    "threshold": lambda q, now, p, state: (np.maximum(q - p["zone"], 0.0), None),
    # Vanishes at zero and full flow.
    "bent": lambda q, now, p, state: (q * (1 + 4 * p["bow"] * (1 - q / p["rated"])), None),
    "scaled": lambda q, now, p, state: (p["gain"] * q, None),
    "slow": slow,
    "slow_in_two_poles": slow_in_two_poles,
    # A centrifugal pump's curve; linear and quadratic in the level.
    "shut_off_head": lambda q, now, p, state: (q * np.sqrt(np.maximum(1 - now.level / p["head"], 0.0)), None),
    "falling": lambda q, now, p, state: (q * np.maximum(1 - now.level / p["head"], 0.0), None),
    "drooping": lambda q, now, p, state: (q * np.maximum(1 - (now.level / p["head"]) ** 2, 0.0), None),
    "pulsating": lambda q, now, p, state: (q * (1 + p["depth"] * np.sin(2 * np.pi * now.time / p["period"])), None),
    "sputtering": sputtering,
    "tiring": tiring,
    "stalling": stalling,
    "hard_limit": lambda q, now, p, state: (np.minimum(q, p["limit"]), None),
    "rounded_limit": rounded_limit,
}
