"""Drawing of the rig: tanks with their levels, pipes, pumps and sensors, with the diagnosis on them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from textwrap import wrap

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle

from fdi_torch.plant.description import OUTSIDE, Pipe, PlantDescription, Pump, Sensor, Tank
from fdi_torch.report.html import short
from fdi_torch.report.numbers import percent
from fdi_torch.report.rig_layout import tank_places
from fdi_torch.report.style import INK, MARK, MODEL, PAPER, SOFT, styled

INCH = 0.8  # per unit of the drawing; a tank is one unit wide
TALL = 1.4
COLUMN, ROW = 1.95, 3.1
LETTER = 0.1  # largest width of a letter beside a sensor
LINE, WITHIN = 0.2, 9  # height of a line; letters per line within a tank and between tanks
Point = tuple[float, float]


@dataclass(frozen=True)
class Overlay:
    """The diagnosis to draw. levels: tank -> m. marks: location -> texts of diagnosed effects. probabilities: location
    -> probability of a discrepancy there (0 to 1), drawn as strength of colour.
    """

    levels: Mapping[str, float] = field(default_factory=dict)
    marks: Mapping[str, Sequence[str]] = field(default_factory=dict)
    probabilities: Mapping[str, float] = field(default_factory=dict)


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
        self.crossings = 0
        rows = 1 + max(row for row, _ in self.places.values())
        columns = 1 + max(column for _, column in self.places.values())
        longest = max((len(words) for name in plant.locations() for words in self.diagnosis(name)), default=0)
        margin = max(1.0, 0.058 * longest)
        beside = max((len(words) for s in plant.sensors for words, *_ in self.lines(s.name, WITHIN)), default=0)
        left, right = -margin, (columns - 1) * COLUMN + max(margin, 0.8 + LETTER * beside)
        above, below = (
            LINE * max((len(self.diagnosis(part.name)) for part in parts), default=0)
            for parts in (plant.pumps, plant.pipes)
        )
        bottom, top = -(rows - 1) * ROW - 0.85 - below, TALL + 1.05 + above
        self.figure = Figure(figsize=((right - left) * INCH, (top - bottom) * INCH))
        FigureCanvasAgg(self.figure)
        self.axes: Axes = self.figure.add_axes((0.0, 0.0, 1.0, 1.0))
        self.axes.set_xlim(left, right)
        self.axes.set_ylim(bottom, top)
        self.axes.set_axis_off()

    def draw(self) -> None:
        for tank in self.plant.tanks:
            self.overflow(tank)
        for location in (*self.overlay.marks, *self.overlay.probabilities):
            self.pair(location)
        for pipe in self.plant.pipes:
            self.pipe(pipe)
        for tank in self.plant.tanks:
            self.tank(tank)
        for pump in self.plant.pumps:
            self.pump(pump)
        for sensor in self.plant.sensors:
            self.sensor(sensor)

    def corner(self, tank: str) -> Point:
        """Middle of a tank's floor."""
        row, column = self.places[tank]
        return column * COLUMN, -row * ROW

    def colour(self, name: str, plain: str = INK) -> str:
        return MARK if name in self.overlay.marks else plain

    def diagnosis(self, name: str) -> list[str]:
        """Texts of the diagnosis at a component."""
        share = self.overlay.probabilities.get(name, 0.0)
        marks = [short(text, 26) for text in self.overlay.marks.get(name, ())]
        return [*marks, percent(share)] if share >= 0.005 else marks

    def lines(self, name: str, width: int) -> list[tuple[str, str, str]]:
        """Text, colour and weight of each line at a component."""
        marks = [short(text, 26) for text in self.overlay.marks.get(name, ())]
        shares = self.diagnosis(name)[len(marks) :]
        marks = [line for text in marks for line in wrap(text, width, break_long_words=False)]
        tinted = name in self.places and self.overlay.probabilities.get(name, 0.0) > 0.0
        lines = [(short(name, 16), INK, "normal"), *((text, INK if tinted else MARK, "bold") for text in marks)]
        return [*lines, *((text, INK, "bold") for text in shares)]

    def words(self, name: str, point: Point, ha: str, va: str, width: int = 26) -> None:
        """Write a component's name and below it the diagnosis, in lines of `width` letters."""
        x, y = point
        step = LINE if va == "top" else -LINE
        lines = self.lines(name, width)
        for k, (text, colour, weight) in enumerate(lines if va == "top" else reversed(lines)):
            self.axes.text(x, y - k * step, text, ha=ha, va=va, color=colour, weight=weight, fontsize=9.0, zorder=6)

    def line(self, name: str, points: Sequence[Point], arrow: bool = False) -> None:
        """Draw a pipe along points, highlighted if it has a discrepancy."""
        x, y = np.array(points).T
        if self.overlay.probabilities.get(name, 0.0) > 0.0:
            self.axes.plot(
                x, y, color=MARK, lw=11, alpha=strength(self.overlay.probabilities[name]), solid_capstyle="round"
            )
        self.axes.plot(x, y, color=self.colour(name), lw=2.4 if name in self.overlay.marks else 1.6, zorder=2)
        if arrow:
            self.axes.add_patch(_arrow_head(points[-1], self.colour(name)))

    def tank(self, tank: Tank) -> None:
        x, y = self.corner(tank.name)
        probability = self.overlay.probabilities.get(tank.name, 0.0)
        self.axes.add_patch(Rectangle((x - 0.5, y), 1.0, TALL, facecolor=PAPER, edgecolor="none", zorder=3))
        if probability > 0.0:
            fill = Rectangle(
                (x - 0.5, y), 1.0, TALL, facecolor=MARK, alpha=strength(probability), edgecolor="none", zorder=3
            )
            self.axes.add_patch(fill)
        level = self.overlay.levels.get(tank.name, float("nan"))
        if np.isfinite(level):
            height = TALL * min(max(level / tank.height, 0.0), 1.0)
            water = Rectangle((x - 0.5, y), 1.0, height, facecolor=MODEL, alpha=0.22, edgecolor="none", zorder=3)
            self.axes.add_patch(water)
            self.axes.plot([x - 0.5, x + 0.5], [y + height] * 2, color=MODEL, lw=1.2, zorder=4)
            place = height + (0.05 if height < 0.3 else -0.24)
            free = TALL - 0.08 - LINE * len(self.lines(tank.name, WITHIN)) - 0.22  # below the words of the tank
            place = max(min(place, free), 0.04)
            self.axes.text(x, y + place, f"{100 * level:.1f} cm", ha="center", color=INK, fontsize=9.0, zorder=6)
        walls = [(x - 0.5, y + TALL), (x - 0.5, y), (x + 0.5, y), (x + 0.5, y + TALL)]
        self.axes.plot(*np.array(walls).T, color=self.colour(tank.name), lw=2.0, zorder=5, solid_joinstyle="miter")
        self.words(tank.name, (x, y + TALL - 0.08), "center", "top", width=WITHIN)

    def pump(self, pump: Pump) -> None:
        x, y = self.corner(pump.target)
        same = [p.name for p in self.plant.pumps if p.target == pump.target]
        x += (same.index(pump.name) - (len(same) - 1) / 2) * 0.7 - (0.22 if self.fed_from_above(pump.target) else 0.0)
        centre, radius = (x, y + TALL + 0.55), 0.17
        self.line(pump.name, [(x, centre[1] - radius), (x, y + TALL + 0.06)], arrow=True)
        probability = self.overlay.probabilities.get(pump.name, 0.0)
        self.axes.add_patch(Circle(centre, radius, facecolor=PAPER, edgecolor=self.colour(pump.name), lw=1.6, zorder=4))
        if probability > 0.0:
            self.axes.add_patch(Circle(centre, 1.6 * radius, facecolor=MARK, alpha=strength(probability), zorder=5))
        blade = [(x - 0.1, centre[1] + 0.07), (x + 0.1, centre[1] + 0.07), (x, centre[1] - 0.13)]
        self.axes.add_patch(Polygon(blade, facecolor=self.colour(pump.name), edgecolor="none", zorder=5))
        self.words(pump.name, (x, centre[1] + radius + 0.08), "center", "bottom")

    def sensor(self, sensor: Sensor) -> None:
        x, y = self.corner(sensor.tank)
        same = [s.name for s in self.plant.sensors if s.tank == sensor.tank]
        centre = (x + 0.5, y + 0.85 - 0.4 * same.index(sensor.name))
        probability = self.overlay.probabilities.get(sensor.name, 0.0)
        if probability > 0.0:
            self.axes.add_patch(Circle(centre, 0.2, facecolor=MARK, alpha=strength(probability), zorder=6))
        colour = self.colour(sensor.name)
        self.axes.add_patch(Circle(centre, 0.085, facecolor=PAPER, edgecolor=colour, lw=1.6, zorder=7))
        self.words(sensor.name, (centre[0] + 0.12, centre[1] + 0.1), "left", "top", width=WITHIN)

    def pipe(self, pipe: Pipe) -> None:
        points = self.route(pipe)
        self.line(pipe.name, points, arrow=pipe.is_outlet)
        middle = _middle(points)
        if pipe.valve:
            self.valve(middle, self.colour(pipe.name), upright=points[0][0] == points[-1][0])
        if pipe.target == OUTSIDE:
            self.words(pipe.name, (points[-1][0], points[-1][1] - 0.06), "center", "top")
        elif pipe.is_outlet:
            self.words(pipe.name, (middle[0] + 0.12, middle[1] + 0.1), "left", "top")
        else:
            self.words(
                pipe.name, (middle[0], min(middle[1], self.corner(pipe.source)[1] + 0.12) - 0.18), "center", "top"
            )

    def route(self, pipe: Pipe) -> list[Point]:
        """Corner points of a pipe."""
        x, y = self.corner(pipe.source)
        rise = TALL * min(pipe.elevation / self.tank_height(pipe.source), 0.9)
        if pipe.target == OUTSIDE:
            out = [p.name for p in self.plant.pipes if p.source == pipe.source and p.target == OUTSIDE]
            x += 0.3 * (out.index(pipe.name) - (len(out) - 1) / 2)
            return [(x, y + rise), (x, y - 0.55)]
        to_x, to_y = self.corner(pipe.target)
        if pipe.free_fall:
            to_x += 0.22
            return [(x + 0.22, y), (x + 0.22, y - 0.3), (to_x, y - 0.3), (to_x, to_y + TALL + 0.06)]
        side = 0.5 if to_x > x else -0.5
        same = [p.name for p in self.plant.pipes if {p.source, p.target} == {pipe.source, pipe.target}]
        rise += 0.12 + 0.28 * same.index(pipe.name)
        if y == to_y and abs(to_x - x) <= COLUMN:
            return [(x + side, y + rise), (to_x - side, to_y + rise)]
        self.crossings += 1
        low = min(y, to_y) - 0.16 - 0.12 * self.crossings
        return [(x + 0.6 * side, y), (x + 0.6 * side, low), (to_x - 0.6 * side, low), (to_x - 0.6 * side, to_y)]

    def valve(self, middle: Point, colour: str, upright: bool) -> None:
        """Draw a bow tie across the pipe: its opening is measured."""
        a, b = np.array([[-0.12, 0.08], [-0.12, -0.08], [0.12, 0.08], [0.12, -0.08]]).T
        x, y = (b, a) if upright else (a, b)
        self.axes.add_patch(
            Polygon(np.stack((x + middle[0], y + middle[1]), 1), facecolor=PAPER, edgecolor=colour, lw=1.2, zorder=4)
        )

    def overflow(self, tank: Tank) -> None:
        """Draw the overflow of a tank into another one, dotted."""
        if tank.overflow_to == OUTSIDE:
            return
        (x, y), (to_x, to_y) = self.corner(tank.name), self.corner(tank.overflow_to)
        path = [
            (x - 0.5, y + TALL),
            (x - 0.68, y + TALL),
            (x - 0.68, to_y + TALL + 0.2),
            (to_x - 0.3, to_y + TALL + 0.2),
        ]
        self.axes.plot(*np.array(path).T, color=SOFT, lw=1.0, ls=":", zorder=1)

    def pair(self, location: str) -> None:
        """Draw an unmodelled flow between two tanks, dashed."""
        pairs = {f"{a}-{b}": (a, b) for a, b in self.plant.tank_pairs()}
        if location not in pairs:
            return
        (x, y), (to_x, to_y) = (self.corner(name) for name in pairs[location])
        points = [(x, y + 0.42), (to_x, to_y + 0.42)]
        alpha = 1.0 if location in self.overlay.marks else strength(self.overlay.probabilities.get(location, 0.0))
        self.axes.plot(*np.array(points).T, color=MARK, lw=1.8, ls="--", alpha=alpha, zorder=1)
        if location in self.overlay.marks:
            self.words(location, ((x + to_x) / 2, (y + to_y) / 2 + 1.3), "center", "top")

    def fed_from_above(self, tank: str) -> bool:
        return any(p.free_fall and p.target == tank for p in self.plant.pipes)

    def tank_height(self, name: str) -> float:
        return next(t.height for t in self.plant.tanks if t.name == name)


def strength(share: float) -> float:
    """Opacity of a location by its probability (0 to 1); cubic, so that certain locations stand out."""
    return 0.3 * share**3


def _middle(points: Sequence[Point]) -> Point:
    """Middle of the longest straight piece."""
    pieces = list(pairwise(points))
    a, b = max(pieces, key=lambda piece: abs(piece[0][0] - piece[1][0]) + abs(piece[0][1] - piece[1][1]))
    return (a[0] + b[0]) / 2, (a[1] + b[1]) / 2


def _arrow_head(tip: Point, colour: str) -> Polygon:
    x, y = tip
    return Polygon([(x - 0.08, y + 0.14), (x + 0.08, y + 0.14), (x, y)], facecolor=colour, edgecolor="none", zorder=4)
