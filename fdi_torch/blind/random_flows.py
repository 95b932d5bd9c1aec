"""Random disturbances of the flows into a hidden rig's tanks: white, held for some seconds, or varying slowly.

A disturbance is one flow for each tank and second, constant over that second (m^3/s once it is scaled):
    white   a new value every second;
    held    a new value every 15 or 60 s;
    slow    Ornstein-Uhlenbeck, d_{i+1} = a d_i + sqrt(1 - a^2) w_i with a = exp(-1 s / tau), tau of 100 to 600 s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from fdi_torch.blind.deviation import Array

KINDS = ("white", "held", "slow")
HOLDS = (15, 60)  # s
SHORTEST_TIME, LONGEST_TIME = 100.0, 600.0  # correlation time, s
LEAST, MOST = 0.3, 3.0  # root mean square change of the levels, over the sensors' noise


@dataclass(frozen=True)
class Disturbance:
    """time: s for which a value is held (white: 1, held), or the correlation time (slow). intensities (N,): of each
    tank, relative to each other. ratio: root mean square change of the levels, over the sensors' noise.
    """

    kind: str
    time: float
    intensities: Array
    ratio: float

    def values(self, rng: np.random.Generator, samples: int) -> Array:
        """Random flows (T, N) with standard deviations `intensities`."""
        wide = len(self.intensities)
        if self.kind == "slow":
            keep = math.exp(-1.0 / self.time)
            steps = rng.normal(size=(samples, wide))
            steps[1:] *= math.sqrt(1 - keep**2)
            for i in range(1, samples):
                steps[i] += keep * steps[i - 1]
            return self.intensities * steps
        hold = int(self.time)
        return self.intensities * np.repeat(rng.normal(size=(-(-samples // hold), wide)), hold, axis=0)[:samples]

    def as_dict(self) -> dict[str, Any]:
        return {"kind": self.kind, "time_s": self.time}


def draw_disturbance(rng: np.random.Generator, tanks: int) -> Disturbance:
    """A kind with equal probabilities; sizes log-uniform from 0.3 to 3 times the noise."""
    kind = str(rng.choice(KINDS))
    times = {
        "white": 1.0,
        "held": float(rng.choice(HOLDS)),
        "slow": math.exp(rng.uniform(math.log(SHORTEST_TIME), math.log(LONGEST_TIME))),
    }
    ratio = math.exp(rng.uniform(math.log(LEAST), math.log(MOST)))
    return Disturbance(kind, times[kind], rng.uniform(0.5, 1.5, size=tanks), ratio)
