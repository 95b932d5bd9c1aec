"""Routes of the lines of flow components in the drawing of a rig, around its tanks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from fdi_torch.plant.description import OUTSIDE, PlantDescription
from fdi_torch.plant.flow_component import FlowComponent, Sketch
from fdi_torch.report.rig_layout import Place, Point

LOWEST = 0.12  # height of a line between two tanks above their floors
ASIDE, LANE = 0.68, 0.36  # from a tank's middle to a line beside its left wall, and on to the next one


@dataclass(frozen=True)
class TankGrid:
    """Tanks one unit wide in rows and columns. column, row: distance of the middles of two neighbours; tall: their
    height.
    """

    places: Mapping[str, Place]
    column: float
    row: float
    tall: float

    def corner(self, tank: str) -> Point:
        """Middle of a tank's floor."""
        row, column = self.places[tank]
        return column * self.column, -row * self.row


class FlowRoutes:
    """Corner points of the lines, each of which keeps clear of those before it."""

    def __init__(self, plant: PlantDescription, grid: TankGrid) -> None:
        self.plant, self.tall, self.column, self.corner = plant, grid.tall, grid.column, grid.corner
        self.crossings = self.besides = 0  # lines so far below the tanks, and beside them

    def route(self, component: FlowComponent, sketch: Sketch) -> list[Point]:
        """Corner points of a flow component's line."""
        if sketch.route == "from_above":
            return self._from_above(component, sketch)
        x, y = self.corner(component.source)
        rise = self.tall * min(sketch.height / self.plant.tank(component.source).height, 0.9)
        if sketch.route == "over_wall":
            return self._over_wall(component, rise)
        flows = [c for c in self.plant.flow_components() if c.sketch().route == sketch.route]
        if component.target == OUTSIDE:
            out = [c.name for c in flows if c.source == component.source and c.target == OUTSIDE]
            x += 0.3 * (out.index(component.name) - (len(out) - 1) / 2)
            return [(x, y + rise), (x, y - 0.55)]
        to_x, to_y = self.corner(component.target)
        if component.falls:
            to_x += 0.22
            return [(x + 0.22, y), (x + 0.22, y - 0.3), (to_x, y - 0.3), (to_x, to_y + self.tall + 0.06)]
        side = 0.5 if to_x > x else -0.5
        same = [c.name for c in flows if {c.source, c.target} == {component.source, component.target}]
        rise += LOWEST + 0.28 * same.index(component.name)
        if y == to_y and abs(to_x - x) < 1.01 * self.column:  # the next tank
            return [(x + side, y + rise), (to_x - side, to_y + rise)]
        if x == to_x and sketch.arrow:
            return self._beside((x - 0.5, y + rise), to_x, to_y)
        self.crossings += 1
        low = min(y, to_y) - 0.16 - 0.12 * self.crossings
        return [(x + 0.6 * side, y), (x + 0.6 * side, low), (to_x - 0.6 * side, low), (to_x - 0.6 * side, to_y)]

    def fed_from_above(self, tank: str) -> bool:
        """Whether water falls into the tank from another one."""
        return any(c.falls and c.target == tank for c in self.plant.flow_components())

    def _from_above(self, component: FlowComponent, sketch: Sketch) -> list[Point]:
        """From a symbol above the target down to its rim."""
        x, y = self.corner(component.target)
        same = [c.name for c in self.plant.flow_components() if c.source == OUTSIDE and c.target == component.target]
        fed = 0.22 if self.fed_from_above(component.target) else 0.0
        x += (same.index(component.name) - (len(same) - 1) / 2) * 0.7 - fed
        return [(x, y + self.tall + 0.55 - sketch.round), (x, y + self.tall + 0.06)]

    def _over_wall(self, component: FlowComponent, rise: float) -> list[Point]:
        """Over the source's wall at the height `rise`, then down outside or into the target."""
        x, y = self.corner(component.source)
        if component.target == OUTSIDE:
            return [(x - 0.5, y + rise), (x - ASIDE, y + rise), (x - ASIDE, y - 0.45)]
        to_x, to_y = self.corner(component.target)
        if to_y != y:
            return self._beside((x - 0.5, y + rise), to_x, to_y)
        side = 0.5 if to_x > x else -0.5
        return [(x + side, y + rise), (to_x - side, y + rise)]

    def _beside(self, start: Point, to_x: float, to_y: float) -> list[Point]:
        """From the left wall of a tank, past this tank, to the rim of a tank in another row."""
        self.besides += 1
        lane, above = start[0] + 0.5 - ASIDE - LANE * (self.besides - 1), to_y + self.tall + 0.14 + 0.1 * self.besides
        end = to_x - 0.2 - 0.12 * self.besides
        return [start, (lane, start[1]), (lane, above), (end, above), (end, to_y + self.tall + 0.06)]
