"""The nominal run of a case, against which causes are drawn, so that their thresholds are crossed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fdi_torch.blind.deviation import Array
from fdi_torch.blind.simulator import conductance
from fdi_torch.plant.description import Pipe, PlantDescription, Pump, Sensor


@dataclass(frozen=True)
class NominalRun:
    """Run of a case's rig without deviations.

    plant: as built. levels (T, N) m and asked (T, M) m^3/s: levels and requested flows of the recording. strength: of
    the effects, 1 usual, 0.2 weak. rng: random generator of the case.
    """

    plant: PlantDescription
    levels: Array
    asked: Array
    strength: float
    rng: np.random.Generator

    @property
    def seconds(self) -> float:
        return float(len(self.levels) - 1)

    def uniform(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def size(self, low: float, high: float) -> float:
        """A size in its usual range, times the strength."""
        return self.strength * self.uniform(low, high)

    def either(self, low: float, high: float) -> float:
        """A size with random sign."""
        return self.size(low, high) * (1.0 if self.rng.random() < 0.5 else -1.0)

    def one_of(self, *laws: str) -> str:
        return laws[int(self.rng.integers(len(laws)))]

    def pump(self, name: str) -> tuple[float, float]:
        """Lowest and highest flow requested from the pump, m^3/s."""
        column = self.asked[:, [p.name for p in self.plant.pumps].index(name)]
        return float(column.min()), float(column.max())

    def pump_range(self, name: str) -> float:
        """Difference of the highest and lowest flow requested from the pump, m^3/s."""
        low, high = self.pump(name)
        return high - low

    def area(self, tank: str) -> float:
        """Cross-section of the tank, m^2."""
        return self.plant.tank(tank).area

    def tank(self, name: str, share: float) -> float:
        """The level below which the tank is for this share of the time, m."""
        column = self.levels[:, [t.name for t in self.plant.tanks].index(name)]
        return float(np.quantile(column, share))

    def span(self, tank: str) -> float:
        """Range of the tank's level without its lowest and highest 2 %, m."""
        return self.tank(tank, 0.98) - self.tank(tank, 0.02)

    def tank_of(self, location: str) -> str:
        """The tank that a pump feeds, a sensor measures or a pipe drains."""
        component = self.plant.component(location)
        if isinstance(component, Pump):
            return component.target
        if isinstance(component, Pipe):
            return component.source
        return component.tank if isinstance(component, Sensor) else component.name

    def head(self, pipe: str, share: float) -> float:
        """The quantile of the pipe's driving head, m: it is below this for that share of the time."""
        tanks = [t.name for t in self.plant.tanks]
        p = self.plant.pipe(pipe)
        head = self.levels[:, tanks.index(p.source)] - p.elevation
        if not p.is_outlet:
            head = head - (self.levels[:, tanks.index(p.target)] - p.elevation)
        return float(np.quantile(np.abs(head), share))

    def conductance_of(self, pipe: str) -> float:
        """Discharge coefficient x bore x sqrt(2 g) of a pipe, m^2.5/s."""
        return float(conductance(self.plant)[[p.name for p in self.plant.pipes].index(pipe)])

    def conductance_at(self, tank: str) -> float:
        """Conductance of the pipe with which a leak of this tank is compared, m^2.5/s."""
        touching = [p.name for p in self.plant.pipes if tank in (p.source, p.target)]
        return self.conductance_of(self.plant.tank(tank).leak_reference or touching[0])
