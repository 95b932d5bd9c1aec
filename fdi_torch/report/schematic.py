"""Drawing of the rig: tanks with their levels, flow components and sensors, with the diagnosis on them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle

from fdi_torch.plant.description import OUTSIDE, PlantDescription, Sensor, Tank
from fdi_torch.plant.flow_component import FlowComponent, Sketch
from fdi_torch.report.flow_routes import ASIDE, LOWEST, FlowRoutes, TankGrid
from fdi_torch.report.html import short
from fdi_torch.report.rig_layout import (
    GAP,
    LINE,
    POINTS,
    Box,
    LetterStyle,
    Overlay,
    Point,
    TextBlock,
    arrow_head,
    direction,
    level_text,
    longest_piece,
    separated,
    tank_places,
    text_width,
)
from fdi_torch.report.style import INK, MARK, MODEL, PAPER, SOFT, styled

INCH = 0.8  # per unit of the drawing; a tank is one unit wide
POINTS_PER_UNIT = 72 * INCH
TALL = 1.4  # minimum height of a tank
COLUMN, BETWEEN = 1.95, 1.7  # minimum distance of two tanks' middles; minimum free height between two rows


def schematic(plant: PlantDescription, overlay: Overlay | None = None) -> Figure:
    """The complete rig; sizes are not to scale, but levels are, between floor and rim."""
    drawing = _Drawing(plant, overlay or Overlay())
    with styled():
        drawing.draw()
    return drawing.figure


class _Drawing:
    def __init__(self, plant: PlantDescription, overlay: Overlay) -> None:
        self.plant, self.overlay = plant, overlay
        self.places = tank_places(plant)
        self.ends: list[Point] = []  # of the lines of flow components
        self.blocks: list[TextBlock] = []
        counts = {c.name: len(self.lines(c.name)) for c in plant.components()}
        tall = max(TALL, 0.4 + LINE * (1 + max(counts[t.name] for t in plant.tanks)))
        most = max((counts[c.name] for c in plant.flow_components()), default=1)
        row = tall + BETWEEN + LINE * max(0, 2 * most - 4)  # words below a tank and above the next row
        beside = max((text_width(t, w) for x in plant.sensors for t, _, w in self.lines(x.name)), default=0.0)
        grid = TankGrid(self.places, max(COLUMN, 1.24 + beside / POINTS_PER_UNIT), row, tall)
        self.tall, self.corner = tall, grid.corner
        self.routes = FlowRoutes(plant, grid)
        self.figure = Figure()
        FigureCanvasAgg(self.figure)
        self.axes: Axes = self.figure.add_axes((0.0, 0.0, 1.0, 1.0))
        self.axes.set_axis_off()

    def draw(self) -> None:
        for tank in self.plant.tanks:
            self.overflow(tank)
        for location in (*self.overlay.marks, *self.overlay.probabilities):
            self.pair(location)
        above = [c for c in self.plant.flow_components() if c.source == OUTSIDE]
        for component in (c for c in self.plant.flow_components() if c not in above):
            self.flow(component)
        for tank in self.plant.tanks:
            self.tank(tank)
        for component in above:
            self.flow(component)
        for sensor in self.plant.sensors:
            self.sensor(sensor)
        self.write()

    def write(self) -> None:
        """Write all texts, moved apart, and choose the limits of the drawing such that everything is in it."""
        tanks = [self.tank_box(tank.name) for tank in self.plant.tanks]
        blocks = separated(self.blocks, tanks)
        for block in blocks:
            self.write_lines(block)
        boxes = [*tanks, *(block.box for block in blocks)]
        drawn = self.axes.dataLim
        left, bottom = min(drawn.x0, *(b[0] for b in boxes)) - 0.15, min(drawn.y0, *(b[1] for b in boxes)) - 0.15
        right, top = max(drawn.x1, *(b[2] for b in boxes)) + 0.15, max(drawn.y1, *(b[3] for b in boxes)) + 0.15
        self.figure.set_size_inches((right - left) * INCH, (top - bottom) * INCH)
        self.axes.set_xlim(left, right)
        self.axes.set_ylim(bottom, top)

    def write_lines(self, block: TextBlock) -> None:
        va = "top" if block.down else "bottom"
        for (x, y), (text, colour, weight) in block.placed_lines():
            self.axes.text(x, y, text, ha=block.ha, va=va, color=colour, weight=weight, fontsize=POINTS, zorder=6)

    def tank_box(self, tank: str) -> Box:
        x, y = self.corner(tank)
        return x - 0.5, y, x + 0.5, y + self.tall

    def colour(self, name: str) -> str:
        return MARK if name in self.overlay.marks else INK

    def lines(self, name: str) -> list[LetterStyle]:
        """The lines at a component: its name and below it the diagnosis."""
        tinted = name in self.places and self.overlay.opacity(name) > 0.0
        return [(short(name, 16), INK, "normal"), *self.overlay.lines(name, INK if tinted else MARK)]

    def block(self, name: str, point: Point, ha: str, down: bool = True) -> TextBlock:
        return TextBlock(self.lines(name), point, ha, down, POINTS_PER_UNIT)

    def words(self, name: str, point: Point, ha: str, va: str) -> None:
        """Have a component's lines written at a point; they move from it if other texts stand there."""
        self.blocks.append(self.block(name, point, ha, va == "top"))

    def line(self, name: str, points: Sequence[Point], arrow: bool = False) -> None:
        """Draw a line along points, highlighted if it has a discrepancy."""
        x, y = np.array(points).T
        if alpha := self.overlay.opacity(name):
            self.axes.plot(x, y, color=MARK, lw=11, alpha=alpha, solid_capstyle="round")
        self.axes.plot(x, y, color=self.colour(name), lw=2.4 if name in self.overlay.marks else 1.6, zorder=2)
        if arrow:
            self.axes.add_patch(arrow_head(points[-1], direction(points[-2], points[-1]), self.colour(name)))

    def tank(self, tank: Tank) -> None:
        x, y = self.corner(tank.name)

        def fill(height: float, colour: str, alpha: float = 1.0) -> None:
            shape = Rectangle((x - 0.5, y), 1.0, height, facecolor=colour, alpha=alpha, edgecolor="none", zorder=3)
            self.axes.add_patch(shape)

        fill(self.tall, PAPER)
        if alpha := self.overlay.opacity(tank.name):
            fill(self.tall, MARK, alpha)
        level = self.overlay.levels.get(tank.name, float("nan"))
        first = self.tall - 0.08  # upper end of the tank's words
        if np.isfinite(level):
            height = self.tall * min(max(level / tank.height, 0.0), 1.0)
            fill(height, MODEL, 0.22)
            self.axes.plot([x - 0.5, x + 0.5], [y + height] * 2, color=MODEL, lw=1.2, zorder=4)
            lines, above = LINE * len(self.lines(tank.name)), first + GAP / 2 - height
            if 0.0 < above < lines:  # the surface comes to lie between two lines
                first -= above % LINE
            place = height + (0.05 if height < 0.3 else -0.24)
            place = max(min(place, first - lines - 0.22), 0.04)  # below the words of the tank
            self.axes.text(x, y + place, level_text(level), ha="center", color=INK, fontsize=9.0, zorder=6)
        walls = [(x - 0.5, y + self.tall), (x - 0.5, y), (x + 0.5, y), (x + 0.5, y + self.tall)]
        self.axes.plot(*np.array(walls).T, color=self.colour(tank.name), lw=2.0, zorder=5, solid_joinstyle="miter")
        self.write_lines(self.block(tank.name, (x, y + first), "center"))

    def sensor(self, sensor: Sensor) -> None:
        x, y = self.corner(sensor.tank)
        names = [s.name for s in self.plant.sensors if s.tank == sensor.tank]
        heights = [max(0.4, LINE * len(self.lines(name)) + 0.1) for name in names]
        first = min(max(0.85, sum(heights) + 0.2), self.tall - 0.1)
        side = -1.0 if self.joined(sensor.tank, 0.5) > self.joined(sensor.tank, -0.5) else 1.0
        centre = (x + 0.5 * side, y + first - sum(heights[: names.index(sensor.name)]))
        if alpha := self.overlay.opacity(sensor.name):
            self.axes.add_patch(Circle(centre, 0.2, facecolor=MARK, alpha=alpha, zorder=6))
        colour = self.colour(sensor.name)
        self.axes.add_patch(Circle(centre, 0.085, facecolor=PAPER, edgecolor=colour, lw=1.6, zorder=7))
        self.words(sensor.name, (centre[0] + 0.12 * side, centre[1] + 0.1), "left" if side > 0.0 else "right", "top")

    def joined(self, tank: str, wall: float) -> int:
        """Number of lines that meet a wall above the floor, where its sensors are drawn."""
        x, y = self.corner(tank)
        return sum(abs(end[0] - x - wall) < 1e-9 and LOWEST < end[1] - y - 1e-9 < self.tall for end in self.ends)

    def flow(self, component: FlowComponent) -> None:
        """Draw a flow component as its `sketch` declares: a line along its route with its symbol."""
        sketch = component.sketch()
        points = self.routes.route(component, sketch)
        self.ends += [points[0], points[-1]]
        self.line(component.name, points, arrow=sketch.arrow)
        start, end = longest_piece(points)
        middle = (start[0] + end[0]) / 2, (start[1] + end[1]) / 2
        if sketch.route == "from_above":
            middle = points[0][0], points[0][1] + sketch.round
        if sketch.symbol:
            self.symbol(component.name, sketch, middle, direction(start, end))
        if sketch.route == "from_above":
            top = middle[1] + sketch.round + 0.08
            if self.routes.fed_from_above(component.target):  # beside the flow from above
                self.words(component.name, (middle[0] + 2 * sketch.round, top), "right", "bottom")
            else:
                self.words(component.name, (middle[0], top), "center", "bottom")
        elif component.target == OUTSIDE:
            self.words(component.name, (points[-1][0], points[-1][1] - 0.06), "center", "top")
        elif start[1] == end[1] > self.corner(component.source)[1] + LOWEST:
            self.words(component.name, (middle[0], middle[1] + 0.03 + sketch.round), "center", "bottom")
        elif start[0] == end[0] and middle[0] < self.corner(component.source)[0] - 0.5:
            self.words(component.name, (middle[0] - 0.08 - sketch.round, middle[1] + 0.1), "right", "top")
        elif component.falls and start[0] == end[0]:
            self.words(component.name, (middle[0] + 0.12, middle[1] + 0.1), "left", "top")
        else:
            low = min(middle[1], self.corner(component.source)[1] + LOWEST) - 0.18 - sketch.round
            self.words(component.name, (middle[0], low), "center", "top")

    def symbol(self, name: str, sketch: Sketch, middle: Point, direction: Point) -> None:
        """Draw a component's symbol at the middle of its line, turned into the direction of the flow."""
        colour = self.colour(name)
        if sketch.round:
            self.axes.add_patch(Circle(middle, sketch.round, facecolor=PAPER, edgecolor=colour, lw=1.6, zorder=4))
            if alpha := self.overlay.opacity(name):
                self.axes.add_patch(Circle(middle, 1.6 * sketch.round, facecolor=MARK, alpha=alpha, zorder=5))
        (x, y), (cos, sin) = middle, direction
        corners = [(x + a * cos - b * sin, y + a * sin + b * cos) for a, b in sketch.symbol]
        if sketch.round:
            self.axes.add_patch(Polygon(corners, facecolor=colour, edgecolor="none", zorder=5))
        else:
            self.axes.add_patch(Polygon(corners, facecolor=PAPER, edgecolor=colour, lw=1.2, zorder=4))

    def overflow(self, tank: Tank) -> None:
        """Draw the overflow of a tank into another one, dotted."""
        if tank.overflow_to == OUTSIDE:
            return
        (x, y), (to_x, to_y) = self.corner(tank.name), self.corner(tank.overflow_to)
        rim, above = y + self.tall, to_y + self.tall + 0.2
        path = [(x - 0.5, rim), (x - ASIDE, rim), (x - ASIDE, above), (to_x - 0.3, above)]
        self.axes.plot(*np.array(path).T, color=SOFT, lw=1.0, ls=":", zorder=1)

    def pair(self, location: str) -> None:
        """Draw an unmodelled flow between two tanks, dashed."""
        tanks = self.plant.tanks_at(location)
        if len(tanks) != 2:
            return
        (x, y), (to_x, to_y) = (self.corner(name) for name in tanks)
        points = [(x, y + 0.42), (to_x, to_y + 0.42)]
        alpha = 1.0 if location in self.overlay.marks else self.overlay.opacity(location)
        self.axes.plot(*np.array(points).T, color=MARK, lw=1.8, ls="--", alpha=alpha, zorder=1)
        if location in self.overlay.marks:
            self.words(location, ((x + to_x) / 2, (y + to_y) / 2 + 1.3), "center", "top")
