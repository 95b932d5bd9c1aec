"""What goes wrong at the hidden rigs' tanks.

A tank law is f(level, other, now, p, state) -> (q, state): q (n,) m^3/s leaves the tank, into the other tank where
one is named. A storage law gives the cross-section at levels (m, n) as a share of the nominal one.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from fdi_torch.blind.deviation import Array, Moment, Numbers

Outflow = tuple[Array, Any]


def hole(level: Array, other: Array, now: Moment, p: Numbers, state: Any) -> Outflow:
    """A round hole: partly covered over its own bore, then Torricelli."""
    x = np.maximum(level - p["height"], 0.0)
    return p["conductance"] * np.sqrt(x) * np.minimum(x / p["bore"], 1.0), None


def floor_hole(level: Array, other: Array, now: Moment, p: Numbers, state: Any) -> Outflow:
    return p["conductance"] * np.sqrt(np.maximum(level, 0.0)), None


def slot(level: Array, other: Array, now: Moment, p: Numbers, state: Any) -> Outflow:
    """A narrow gap between two tanks: head = a q + b q^2, so that it is smooth at equal levels."""
    head = level - other
    x = np.abs(head)
    return p["conductance"] * head / (0.5 * np.sqrt(p["viscous"]) + np.sqrt(x + 0.25 * p["viscous"])), None


def window(level: Array, other: Array, now: Moment, p: Numbers, state: Any) -> Outflow:
    """A hole in the wall between two tanks, at some height."""
    head = np.maximum(level - p["height"], 0.0) - np.maximum(other - p["height"], 0.0)
    return p["conductance"] * head / np.sqrt(np.abs(head) + 1e-4), None


def tapped(level: Array, other: Array, now: Moment, p: Numbers, state: Any) -> Outflow:
    """A tap opened at `begin` and closed at `end`, each within `ramp` seconds (negative: a tap running in)."""
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


def brim(level: Array, other: Array, now: Moment, p: Numbers, state: Any) -> Outflow:
    """A long straight edge: what comes in above it runs off, q = q_ref x/x_ref."""
    return p["flow"] * np.maximum(level - p["crest"], 0.0) / p["depth"], None


def siphon(level: Array, other: Array, now: Moment, p: Numbers, state: Any) -> Outflow:
    """Starts when its bend is covered, runs until its mouth sucks air."""
    running = np.zeros(level.shape, dtype=bool) if state is None else state
    running = np.where(running, level > p["mouth"], level > p["bend"])
    return np.where(running, p["conductance"] * np.sqrt(np.maximum(level, 0.0)), 0.0), running


def cycling_user(level: Array, other: Array, now: Moment, p: Numbers, state: Any) -> Outflow:
    """Somebody who draws water on and off, all the time."""
    on = np.mod(now.time / p["period"], 1.0) > 0.55
    return np.where(on & (level > 0), p["draw"], 0.0), None


def float_valve(level: Array, other: Array, now: Moment, p: Numbers, state: Any) -> Outflow:
    """A cistern valve that tops the tank up from outside, opening and closing at two levels."""
    filling = (level < p["high"]) if state is None else state
    filling = np.where(filling, level < p["high"], level < p["low"])
    return np.where(filling, -p["flow"], 0.0), filling


def side_chamber(level: Array, other: Array, now: Moment, p: Numbers, state: Any) -> Outflow:
    """A closed side arm behind a filter: A' s' = q = (h - s) A'/tau."""
    side = level if state is None else state
    new = side + now.dt / p["tau"] * (level - side)
    return p["area"] * (new - side) / now.dt, new


def splashing_in(level: Array, other: Array, now: Moment, p: Numbers, state: Any) -> Outflow:
    """Water from a neighbour, for irregular whiles."""
    t = 2 * np.pi * now.time / p["period"]
    return np.where(np.sin(t) + np.sin(t / 0.618 + 1.0) > 0.8, -p["flow"], 0.0), None


def cone(level: Array, p: Numbers) -> Array:
    """Width grows evenly, so the cross-section with the square: (1 + b h)^2, as believed at a reference level."""
    return ((1 + p["slope"] * level) / (1 + p["slope"] * p["reference"])) ** 2


def wedge(level: Array, p: Numbers) -> Array:
    """One wall leans: the cross-section grows evenly, 1 + b h, as believed at a reference level."""
    return (1 + 2 * p["slope"] * level) / (1 + 2 * p["slope"] * p["reference"])


def block(level: Array, p: Numbers) -> Array:
    """A body with chamfered edges between two levels."""
    x = (level - p["low"]) / (p["high"] - p["low"])
    inside = np.minimum(np.maximum(np.minimum(x, 1 - x) / p["chamfer"], 0.0), 1.0)
    return 1 - p["share"] * inside


def barrel(level: Array, p: Numbers) -> Array:
    """A body bulging in the middle: share (1 - (2x - 1)^6)."""
    x = (level - p["low"]) / (p["high"] - p["low"])
    return 1 - p["share"] * np.maximum(1 - (2 * x - 1) ** 6, 0.0)


def heap(level: Array, p: Numbers) -> Array:
    """A body that is half as wide at its top as at its foot."""
    x = (level - p["low"]) / (p["high"] - p["low"])
    return 1 - np.where((x >= 0) & (x <= 1), p["share"] * (1 - 0.5 * x), 0.0)


TANK_LAWS = {
    law.__name__: law
    for law in (
        hole,
        floor_hole,
        slot,
        window,
        tapped,
        rectangular_weir,
        notched_weir,
        brim,
        siphon,
        cycling_user,
        float_valve,
        side_chamber,
        splashing_in,
    )
}
STORAGE_LAWS = {"cone": cone, "wedge": wedge, "block": block, "barrel": barrel, "heap": heap}
