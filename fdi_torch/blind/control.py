"""Level control of a hidden rig: one pump keeps one level near a set point that changes in random steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdi_torch.blind.deviation import Array
from fdi_torch.plant.description import PlantDescription

LAWS = ("two_point", "proportional_integral")
SHORTEST_SETTING, LONGEST_SETTING = 200, 500  # s for which a set point is held
BAND = 0.01  # of the two-point law, as a share of the tank's height
INTERVAL, RESET = 5, 120.0  # s; sampling interval and reset time of the proportional-integral law


@dataclass(frozen=True)
class LevelControl:
    """Level control by one pump.

    law 'two_point': high or low flow, switched `band` m from the set point, every second. law 'proportional_integral':
    q = middle + gain (e + integral of e / reset) every `INTERVAL` s, with the integral frozen while the pump is at a
    limit. pump, tank: indices in the rig. set_points (T,) m. low, high: limits of the flow, m^3/s. gain: m^2/s.
    quantum: resolution of commands, m^3/s.
    """

    law: str
    pump: int
    tank: int
    set_points: Array
    low: float
    high: float
    band: float
    gain: float
    quantum: float

    def start(self) -> Controller:
        return Controller(self)


class Controller:
    """State of a level control: its output depends on its previous output."""

    def __init__(self, control: LevelControl) -> None:
        self.control, self.pump, self.tank = control, control.pump, control.tank
        self.asked, self.integral = 0.5 * (control.low + control.high), 0.0

    def flow(self, second: int, reading: float) -> float:
        """Requested flow in the next second, m^3/s. reading: m."""
        c = self.control
        error = float(c.set_points[min(second, len(c.set_points) - 1)]) - reading
        if c.law == "two_point":
            self.asked = c.high if error > c.band else c.low if error < -c.band else self.asked
        elif second % INTERVAL == 0:
            integral = self.integral + error * INTERVAL / RESET
            wanted = 0.5 * (c.low + c.high) + c.gain * (error + integral)
            self.asked = min(max(wanted, c.low), c.high)
            self.integral = integral if wanted == self.asked else self.integral
        return round(self.asked / c.quantum) * c.quantum


def draw_control(
    rng: np.random.Generator, plant: PlantDescription, levels: Sequence[Array], limits: Array, quantum: Array
) -> tuple[LevelControl, ...]:
    """The control of one level, for recordings with the lengths of `levels` ((T, N) m, undisturbed, open loop).

    limits (M, 2): lowest and highest flow of each pump, quantum (M,): its least change, m^3/s. Set points lie between
    the fifth and the four fifths of the levels that the open loop reaches, so that the pump can hold them.
    Raises ValueError where no pump feeds a measured tank.
    """
    tanks, measured = [t.name for t in plant.tanks], {s.tank for s in plant.sensors}
    possible = [i for i, pump in enumerate(plant.pumps) if pump.target in measured]
    if not possible:
        raise ValueError(f"plant {plant.name}: expected a pump into a measured tank, got none; add a sensor there")
    pump = int(rng.choice(possible))
    tank, law = tanks.index(plant.pumps[pump].target), str(rng.choice(LAWS))
    height, (low, high) = plant.tanks[tank].height, limits[pump]
    gain = float(rng.uniform(1.0, 4.0)) * (high - low) / (0.1 * height)

    def control(reached: Array) -> LevelControl:
        settings, at = np.empty(len(reached)), 0
        while at < len(reached):
            hold = int(rng.integers(SHORTEST_SETTING, LONGEST_SETTING))
            settings[at : at + hold] = np.quantile(reached[:, tank], rng.uniform(0.2, 0.8))
            at += hold
        return LevelControl(law, pump, tank, settings, low, high, BAND * height, gain, float(quantum[pump]))

    return tuple(control(reached) for reached in levels)
