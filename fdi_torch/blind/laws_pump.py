"""Laws of deviations at the hidden rigs' pumps: maps of the requested flow to the delivered flow.

A law is f(q, now, p, state) -> (q, state): q (n,) m^3/s, p its numbers (n,) each, state None at the first step.
A flow that changes within a step is given as its mean over the step.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from fdi_torch.blind.deviation import Array, Moment, Numbers

Delivered = tuple[Array, Any]


def late(q: Array, now: Moment, p: Numbers, state: Any) -> Delivered:
    """Pure delay: plug flow in a hose."""
    return now.asked(p["delay"]), None


def late_and_smeared(q: Array, now: Moment, p: Numbers, state: Any) -> Delivered:
    """Delay with some mixing: half arrives a little earlier, half a little later."""
    return 0.5 * (now.asked(0.92 * p["delay"]) + now.asked(1.08 * p["delay"])), None


def late_and_slow(q: Array, now: Moment, p: Numbers, state: Any) -> Delivered:
    """Delay, and a first-order valve with a fifth of the delay as time constant."""
    return slow(now.asked(0.8 * p["delay"]), now, {"tau": 0.2 * p["delay"]}, state)


def scaled(q: Array, now: Moment, p: Numbers, state: Any) -> Delivered:
    return p["gain"] * q, None


def soft_threshold(q: Array, now: Moment, p: Numbers, state: Any) -> Delivered:
    """A dead zone whose knee is a hyperbola: (x + sqrt(x^2 + w^2)) / 2 with x = q - d."""
    x = q - p["zone"]
    return np.where(q > 0, 0.5 * (x + np.sqrt(x * x + p["knee"] ** 2)), 0.0), None


def threshold(q: Array, now: Moment, p: Numbers, state: Any) -> Delivered:
    return np.maximum(q - p["zone"], 0.0), None


def hard_limit(q: Array, now: Moment, p: Numbers, state: Any) -> Delivered:
    return np.minimum(q, p["limit"]), None


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


def shut_off_head(q: Array, now: Moment, p: Numbers, state: Any) -> Delivered:
    """A centrifugal pump's curve: q sqrt(1 - h/H)."""
    return q * np.sqrt(np.maximum(1 - now.level / p["head"], 0.0)), None


def falling(q: Array, now: Moment, p: Numbers, state: Any) -> Delivered:
    """Linear in the level: q (1 - h/H)."""
    return q * np.maximum(1 - now.level / p["head"], 0.0), None


def drooping(q: Array, now: Moment, p: Numbers, state: Any) -> Delivered:
    """Quadratic in the level: q (1 - (h/H)^2)."""
    return q * np.maximum(1 - (now.level / p["head"]) ** 2, 0.0), None


def pulsating(q: Array, now: Moment, p: Numbers, state: Any) -> Delivered:
    return q * (1 + p["depth"] * np.sin(2 * np.pi * now.time / p["period"])), None


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
    """Air intake at irregular times."""
    return np.where(_irregular(now.time, p["period"]), p["rest"] * q, q), None


def bent(q: Array, now: Moment, p: Numbers, state: Any) -> Delivered:
    """Nonlinearity that vanishes at zero and full flow: q (1 + 4 b (1 - q/q_max))."""
    return q * (1 + 4 * p["bow"] * (1 - q / p["rated"])), None


def slewing(q: Array, now: Moment, p: Numbers, state: Any) -> Delivered:
    """Rate limit of the flow, m^3/s per second."""
    old = q if state is None else state
    most = p["rate"] * now.dt
    new = old + np.minimum(np.maximum(q - old, -most), most)
    return 0.5 * (old + new), new


def _irregular(time: float, period: Array) -> npt.NDArray[np.bool_]:
    """True for about a quarter of the time at aperiodic intervals: two sines of incommensurate periods."""
    return np.sin(2 * np.pi * time / period) + np.sin(2 * np.pi * time / (0.618 * period) + 1.0) > 0.9


# In the order in which they act: what replaces the command comes first.
PUMP_LAWS = {law.__name__: law for law in (
    late, late_and_smeared, late_and_slow, slewing, sticking, backlash, soft_threshold, threshold, bent, scaled,
    slow, slow_in_two_poles, shut_off_head, falling, drooping, pulsating, sputtering, tiring, stalling,
    hard_limit, rounded_limit
)}  # fmt: skip
