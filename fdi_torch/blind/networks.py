"""Random networks of tanks: tree-like with some cross pipes, with pumps and outlets at some tanks.

Bores, cross-sections, heights and places of pumps and outlets are drawn; the pumps are then scaled together such that
the highest tank rests at a given share of its rim. All pipes lie on the floor, so that q = k sign(x) sqrt|x| makes
levels grow with the square of that scale.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fdi_torch.blind.deviation import Array
from fdi_torch.blind.plants import CM, CM2, CM3, Rig
from fdi_torch.blind.simulator import conductance
from fdi_torch.plant.description import OUTSIDE, Pipe, PlantDescription, Pump, Sensor, Tank

FEWEST, MOST = 3, 12  # tanks
LOWEST, HIGHEST = 0.15, 0.9  # levels without any effect, relative to the rim
INPUT_LOW, INPUT_HIGH = 0.1, 0.6  # commanded flow, as a share of max_flow
_REACH = 3  # a tank is joined to one of the three before it, so that the network is neither a star nor a row
_DISCHARGE, _TOLERANCE, _GRAVITY = 0.6, 0.03, 9.81
_RESTING_HIGH, _RESTING_LOW = 0.62, 0.24  # resting levels relative to the rim; starts are up to a quarter off these
_MOST_DRAWS = 1000


@dataclass(frozen=True)
class Networks:
    """Rigs that are a new random network of `fewest` to `most` tanks in each case."""

    fewest: int = FEWEST
    most: int = MOST
    name: str = "network"

    def __post_init__(self) -> None:
        if not 2 <= self.fewest <= self.most:
            raise ValueError(
                f"random networks: expected 2 <= fewest <= most tanks, got {self.fewest} and {self.most}; "
                "give for example 3..12"
            )

    def rig(self, rng: np.random.Generator) -> Rig:
        """A network whose equilibrium levels at medium inputs lie between two shares of the rims."""
        tanks = int(rng.integers(self.fewest, self.most + 1))
        for _ in range(_MOST_DRAWS):
            plant = _drawn(rng, tanks)
            middle = 0.5 * (INPUT_LOW + INPUT_HIGH) * np.array([p.max_flow for p in plant.pumps])
            heights = np.array([t.height for t in plant.tanks])
            rest = equilibrium(plant, middle)
            scale = _RESTING_HIGH / (rest / heights).max()
            if scale * (rest / heights).min() < _RESTING_LOW:
                continue
            flows = [5 * round(p.max_flow * np.sqrt(scale) / (5 * CM3)) / 1e6 for p in plant.pumps]
            pumps = tuple(replace(p, max_flow=q) for p, q in zip(plant.pumps, flows, strict=True))
            plant = replace(plant, pumps=pumps)
            rest = equilibrium(plant, 0.5 * (INPUT_LOW + INPUT_HIGH) * np.array(flows))
            return Rig(plant, INPUT_LOW, INPUT_HIGH, lowest=LOWEST, highest=HIGHEST, rest=tuple(rest.tolist()))
        raise ValueError(
            f"random network of {tanks} tanks: expected levels within the tanks, got none; allow fewer tanks"
        )


def _drawn(rng: np.random.Generator, count: int) -> PlantDescription:
    """A network with pumps of arbitrary scale."""
    names = [f"T{i + 1}" for i in range(count)]
    ends = [(int(rng.integers(max(0, i - _REACH), i)), i) for i in range(1, count)]
    free = [(i, j) for i in range(count) for j in range(i + 1, count) if (i, j) not in ends and j - i <= 2 * _REACH]
    crossing = int(rng.integers(0, 1 + min(max(1, count // 4), len(free))))
    ends += [free[k] for k in sorted(rng.choice(len(free), size=crossing, replace=False))]
    drained = _some(rng, count, 0.25, count - 1)
    fed = _some(rng, count, 0.3, 0)
    if len(fed) == 1:
        fed = sorted({*fed, int(rng.integers(1, count))})

    def bore() -> float:
        return round(rng.uniform(0.5, 0.9), 2) * CM2

    pipes = [Pipe(f"P{i + 1}_{j + 1}", names[i], names[j], bore(), _DISCHARGE) for i, j in ends]
    outlets = [Pipe(f"OUT{i + 1}", names[i], OUTSIDE, bore(), _DISCHARGE) for i in drained]
    joined = (*pipes, *outlets)
    touching = {name: next(p.name for p in joined if name in (p.source, p.target)) for name in names}
    tanks = tuple(
        Tank(n, round(rng.uniform(120, 320)) * CM2, round(rng.uniform(70, 120)) * CM, leak_reference=touching[n])
        for n in names
    )
    return PlantDescription(
        f"network_of_{count}",
        tanks,
        joined,
        tuple(Pump(f"Q{i + 1}", names[i], rng.uniform(0.6, 1.4) * 200 * CM3) for i in fed),
        tuple(Sensor(f"h{i + 1}", name) for i, name in enumerate(names)),
        tolerances={f"{p.name}.discharge_coefficient": _TOLERANCE for p in joined},
        gravity=_GRAVITY,
    )


def _some(rng: np.random.Generator, count: int, chance: float, always: int) -> list[int]:
    return sorted({always, *np.flatnonzero(rng.random(count) < chance).tolist()})


def equilibrium(plant: PlantDescription, pumped: Array) -> Array:
    """(N,) m: levels at which a network of floor-level pipes rests. pumped (M,) m^3/s.

    A h' = F(h) is integrated by implicit Euler steps of growing length; in the limit they are Newton's method for
    F(h) = 0.
    """
    names = [t.name for t in plant.tanks]
    places = [*names, OUTSIDE]
    source = np.array([places.index(p.source) for p in plant.pipes])
    target = np.array([places.index(p.target) for p in plant.pipes])
    feed = np.bincount([names.index(p.target) for p in plant.pumps], weights=pumped, minlength=len(names))
    incidence = np.zeros((len(places), len(plant.pipes)))
    incidence[source, range(len(source))], incidence[target, range(len(target))] = -1.0, 1.0
    area, k = np.array([t.area for t in plant.tanks]), conductance(plant)
    level, step = np.full(len(names), 0.3), 1.0
    for _ in range(400):
        head = -incidence.T @ np.append(level, 0.0)
        root = np.sqrt(np.abs(head) + 1e-12)
        rate = feed + (incidence @ (k * head / root))[:-1]
        slope = -(incidence * (k / (2 * root))) @ incidence.T
        change = np.linalg.solve(np.diag(area / step) - slope[:-1, :-1], rate)
        level = np.maximum(level + change, 1e-6)
        if step > 1e6 and np.abs(change).max() < 1e-9:
            break
        step = min(1.3 * step, 1e9)
    return level


def with_unmeasured(rig: Rig, share: float, rng: np.random.Generator) -> Rig:
    """The rig without the sensors of this share of its tanks, rounded; at least one sensor remains."""
    sensors = rig.believed.sensors
    gone = min(round(share * len(rig.plant.tanks)), len(sensors) - 1)
    dropped = {sensors[int(k)].name for k in rng.choice(len(sensors), size=gone, replace=False)}

    def kept(plant: PlantDescription) -> PlantDescription:
        return replace(plant, sensors=tuple(s for s in plant.sensors if s.name not in dropped))

    return replace(rig, plant=kept(rig.plant), full_size=rig.full_size and kept(rig.full_size))
