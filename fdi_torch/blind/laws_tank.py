"""Laws of deviations at the hidden rigs' tanks.

A tank law is f(level, other, now, p, state) -> (q, state): q (n,) m^3/s leaves the tank, into the other tank where
one is named. A storage law gives the cross-section at levels (m, n) as a share of the nominal one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from fdi_torch.blind.deviation import Array, Moment, Numbers

Outflow = tuple[Array, Any]


def hole(level: Array, other: Array, now: Moment, p: Numbers, state: Any) -> Outflow:
    """Leak through a round hole: partly submerged over its diameter, then Torricelli."""
    x = np.maximum(level - p["height"], 0.0)
    return p["conductance"] * np.sqrt(x) * np.minimum(x / p["bore"], 1.0), None


def slot(level: Array, other: Array, now: Moment, p: Numbers, state: Any) -> Outflow:
    """A narrow gap between two tanks: head = a q + b q^2, smooth at equal levels."""
    head = level - other
    x = np.abs(head)
    return p["conductance"] * head / (0.5 * np.sqrt(p["viscous"]) + np.sqrt(x + 0.25 * p["viscous"])), None


def window(level: Array, other: Array, now: Moment, p: Numbers, state: Any) -> Outflow:
    """A hole in the wall between two tanks at some height."""
    head = np.maximum(level - p["height"], 0.0) - np.maximum(other - p["height"], 0.0)
    return p["conductance"] * head / np.sqrt(np.abs(head) + 1e-4), None


def tapped(level: Array, other: Array, now: Moment, p: Numbers, state: Any) -> Outflow:
    """A tap that opens at `begin` and closes at `end`, each within `ramp` seconds (negative: inflow)."""
    opened = np.minimum(np.maximum((now.time - p["begin"]) / p["ramp"], 0.0), 1.0)
    closed = np.minimum(np.maximum((now.time - p["end"]) / p["ramp"], 0.0), 1.0)
    dry = (p["draw"] > 0) & (level <= 0)
    return np.where(dry, 0.0, p["draw"] * (opened - closed)), None


def rectangular_weir(level: Array, other: Array, now: Moment, p: Numbers, state: Any) -> Outflow:
    """q = q_ref (x/x_ref)^(3/2) (Poleni)."""
    x = np.maximum(level - p["crest"], 0.0) / p["depth"]
    return p["flow"] * x * np.sqrt(x), None


def notched_weir(level: Array, other: Array, now: Moment, p: Numbers, state: Any) -> Outflow:
    """q = q_ref (x/x_ref)^(5/2) (Thomson)."""
    x = np.maximum(level - p["crest"], 0.0) / p["depth"]
    return p["flow"] * x * x * np.sqrt(x), None


def siphon(level: Array, other: Array, now: Moment, p: Numbers, state: Any) -> Outflow:
    """A siphon: starts when its bend is submerged, stops when its mouth draws air."""
    running = np.zeros(level.shape, dtype=bool) if state is None else state
    running = np.where(running, level > p["mouth"], level > p["bend"])
    return np.where(running, p["conductance"] * np.sqrt(np.maximum(level, 0.0)), 0.0), running


def cycling_user(level: Array, other: Array, now: Moment, p: Numbers, state: Any) -> Outflow:
    """Withdrawal that is switched on and off all the time."""
    on = np.mod(now.time / p["period"], 1.0) > 0.55
    return np.where(on & (level > 0), p["draw"], 0.0), None


def float_valve(level: Array, other: Array, now: Moment, p: Numbers, state: Any) -> Outflow:
    """A float valve that fills the tank from outside, opening and closing at two levels."""
    filling = (level < p["high"]) if state is None else state
    filling = np.where(filling, level < p["high"], level < p["low"])
    return np.where(filling, -p["flow"], 0.0), filling


def side_chamber(level: Array, other: Array, now: Moment, p: Numbers, state: Any) -> Outflow:
    """A closed side chamber behind a filter: A' s' = q = (h - s) A'/tau."""
    side = level if state is None else state
    new = side + now.dt / p["tau"] * (level - side)
    return p["area"] * (new - side) / now.dt, new


def splashing_in(level: Array, other: Array, now: Moment, p: Numbers, state: Any) -> Outflow:
    """Inflow from a neighbouring tank at irregular times."""
    t = 2 * np.pi * now.time / p["period"]
    return np.where(np.sin(t) + np.sin(t / 0.618 + 1.0) > 0.8, -p["flow"], 0.0), None


def block(level: Array, p: Numbers) -> Array:
    """A body with chamfered edges between two levels."""
    x = (level - p["low"]) / (p["high"] - p["low"])
    inside = np.minimum(np.maximum(np.minimum(x, 1 - x) / p["chamfer"], 0.0), 1.0)
    return 1 - p["share"] * inside


def barrel(level: Array, p: Numbers) -> Array:
    """A body that is widest in the middle: share (1 - (2x - 1)^6)."""
    x = (level - p["low"]) / (p["high"] - p["low"])
    return 1 - p["share"] * np.maximum(1 - (2 * x - 1) ** 6, 0.0)


def heap(level: Array, p: Numbers) -> Array:
    """A body whose top is half as wide as its base."""
    x = (level - p["low"]) / (p["high"] - p["low"])
    return 1 - np.where((x >= 0) & (x <= 1), p["share"] * (1 - 0.5 * x), 0.0)


TANK_LAWS: dict[str, Callable[[Array, Array, Moment, Numbers, Any], Outflow]] = {
    "hole": hole,
    "floor_hole": lambda level, other, now, p, state: (p["conductance"] * np.sqrt(np.maximum(level, 0.0)), None),
    "slot": slot,
    "window": window,
    "tapped": tapped,
    "rectangular_weir": rectangular_weir,
    "notched_weir": notched_weir,
    # Overflow over a long straight edge: q = q_ref x/x_ref.
    "brim": lambda level, other, now, p, state: (p["flow"] * np.maximum(level - p["crest"], 0.0) / p["depth"], None),
    "siphon": siphon,
    "cycling_user": cycling_user,
    "float_valve": float_valve,
    "side_chamber": side_chamber,
    "splashing_in": splashing_in,
}
STORAGE_LAWS: dict[str, Callable[[Array, Numbers], Array]] = {
    # Width grows linearly, the cross-section with the square: (1 + b h)^2, nominal at a reference level.
    "cone": lambda level, p: ((1 + p["slope"] * level) / (1 + p["slope"] * p["reference"])) ** 2,
    # One inclined wall: the cross-section grows linearly.
    "wedge": lambda level, p: (1 + 2 * p["slope"] * level) / (1 + 2 * p["slope"] * p["reference"]),
    "block": block,
    "barrel": barrel,
    "heap": heap,
}
