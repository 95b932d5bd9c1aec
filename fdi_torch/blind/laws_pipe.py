"""Laws of deviations at the hidden rigs' pipes and outlets.

A head law maps the driving head (n,) m. A pipe law is f(head, q, now, p, state) -> (factor, state):
what the square-root flow q = k sign(head) sqrt|head| (m^3/s) is multiplied by. A law without memory leaves state None.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from fdi_torch.blind.deviation import Array, Moment, Numbers

Factor = tuple[Array, Any]
_MILLIMETRE = 1e-3


def down_pipe(head: Array, p: Numbers) -> Array:
    """Outlet `drop` below the floor (negative: above): head + drop, fading out over the last millimetre of level."""
    raised = np.maximum(head + p["drop"], 0.0)
    wet = np.minimum(np.maximum(head, 0.0) / _MILLIMETRE, 1.0)
    return raised * wet


def viscous_and_inertial(head: Array, q: Array, now: Moment, p: Numbers, state: Any) -> Factor:
    """Root of head = a q + b q^2 (Darcy-Forchheimer): with e = sqrt(x0/head), f = sqrt(1 + e^2/4) - e/2."""
    e = np.sqrt(p["head"] / np.maximum(np.abs(head), 1e-12))
    return 1.0 / (np.sqrt(1 + 0.25 * e * e) + 0.5 * e), None


def other_power(head: Array, q: Array, now: Moment, p: Numbers, state: Any) -> Factor:
    """((x^2 + w^2) / x_ref^2)^((n - 1/2)/2), w = 2 mm."""
    ratio = (head * head + (2 * _MILLIMETRE) ** 2) / p["reference"] ** 2
    return np.exp(0.5 * (p["power"] - 0.5) * np.log(ratio)), None


def drifting_unevenly(head: Array, q: Array, now: Moment, p: Numbers, state: Any) -> Factor:
    """Monotonic growth with varying speed."""
    t = now.time / p["span"]
    return 1 + p["change"] * (t + 0.12 * np.sin(4 * np.pi * t) / (2 * np.pi)), None


def narrowed(head: Array, q: Array, now: Moment, p: Numbers, state: Any) -> Factor:
    """A smaller (larger) opening from `onset` on, reached within `ramp` seconds."""
    grown = np.minimum(np.maximum((now.time - p["onset"]) / p["ramp"], 0.0), 1.0)
    return 1 - p["loss"] * grown, None


def silting(head: Array, q: Array, now: Moment, p: Numbers, state: Any) -> Factor:
    """Silt that settles at low flow and is washed out at high flow."""
    silt = np.zeros_like(q) if state is None else state
    gain = np.where(np.abs(q) < p["slow"], now.dt / p["settle"], -now.dt / p["wash"])
    return 1 - p["loss"] * silt, np.minimum(np.maximum(silt + gain, 0.0), 1.0)


def two_regimes(head: Array, q: Array, now: Moment, p: Numbers, state: Any) -> Factor:
    """A jet that attaches above one head and detaches below a lower one."""
    attached = (head > p["low"]) if state is None else state
    attached = np.where(attached, head > p["low"], head > p["high"])
    return np.where(attached, 1.0, 1 - p["loss"]), attached


def choked(head: Array, q: Array, now: Moment, p: Numbers, state: Any) -> Factor:
    """A flow limiter: q_max tanh(q/q_max) with a sharper knee."""
    x = (q / p["most"]) ** 2
    return 1 / np.sqrt(np.sqrt(1 + x * x)), None


def blocked_at_times(head: Array, q: Array, now: Moment, p: Numbers, state: Any) -> Factor:
    """A floating object that blocks the inlet at irregular times."""
    t = 2 * np.pi * now.time / p["period"]
    return 1 - p["loss"] * (np.sin(t) + np.sin(t / 0.618 + 1.0) > 0.7), None


HEAD_LAWS = {"down_pipe": down_pipe}
PIPE_LAWS: dict[str, Callable[[Array, Array, Moment, Numbers, Any], Factor]] = {
    "viscous_and_inertial": viscous_and_inertial,
    # Discharge coefficient tending to its turbulent value as tanh of the root of the head.
    "reynolds_blend": lambda head, q, now, p, state: (np.tanh(np.sqrt(np.abs(head) / p["head"])), None),
    # Linear in the head below a threshold, square root above it.
    "sharp_transition": lambda head, q, now, p, state: (np.minimum(np.sqrt(np.abs(head) / p["head"]), 1.0), None),
    "other_power": other_power,
    "drifting_evenly": lambda head, q, now, p, state: (1 + p["change"] * now.time / p["span"], None),
    # Exponential approach: (1 - exp(-1.5 t/T)) / (1 - exp(-1.5)).
    "drifting_to_rest": lambda head, q, now, p, state: (
        1 + p["change"] * (1 - np.exp(-1.5 * now.time / p["span"])) / (1 - np.exp(-1.5)),
        None,
    ),
    # A quarter of a slow sine.
    "drifting_as_sine": lambda head, q, now, p, state: (
        1 + p["change"] * np.sin(0.5 * np.pi * now.time / p["span"]),
        None,
    ),
    "drifting_unevenly": drifting_unevenly,
    "narrowed": narrowed,
    "check_valve": lambda head, q, now, p, state: ((head > 0).astype(np.float64), None),
    "silting": silting,
    "two_regimes": two_regimes,
    # A flap that opens and closes periodically.
    "fluttering": lambda head, q, now, p, state: (1 - p["loss"] * np.sin(np.pi * now.time / p["period"]) ** 2, None),
    "choked": choked,
    "blocked_at_times": blocked_at_times,
    # A different discharge coefficient for reverse flow.
    "lopsided": lambda head, q, now, p, state: (np.where(head > 0, 1 + p["change"], 1 - p["change"]), None),
    # A vortex that entrains air at low head.
    "gulping": lambda head, q, now, p, state: (np.where(np.abs(head) < p["head"], 1 - p["loss"], 1.0), None),
}
