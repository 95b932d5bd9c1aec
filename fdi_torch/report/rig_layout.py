"""Layout of a rig's drawing: flow directions set the rows of its tanks, connections their columns; and the diagnosis on
it: levels, texts at components, which are moved apart where they overlap, and the opacity of colours.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import pairwise
from textwrap import wrap

import numpy as np
from matplotlib.font_manager import FontProperties
from matplotlib.patches import Polygon
from matplotlib.textpath import TextPath

from fdi_torch.amounts import probability_words
from fdi_torch.plant.description import OUTSIDE, PlantDescription
from fdi_torch.report.html import short
from fdi_torch.report.numbers import shown_unit
from fdi_torch.report.style import INK

Place = tuple[int, int]  # row from the top, column from the left


def tank_places(plant: PlantDescription) -> dict[str, Place]:
    """Row and column of every tank, all different.

    A tank is below all tanks that pour into it, beside those with which a pipe levels it, and as close as possible to
    the tanks it is connected to.
    """
    floors = _floors(plant)
    floor_rows = _rows(floors.values(), [(floors[a], floors[b]) for a, b in _falls(plant) if floors[a] != floors[b]])
    rows = {name: floor_rows[floor] for name, floor in floors.items()}
    neighbours = _neighbours(plant)
    places: dict[str, Place] = {}
    for name in _walk(plant, neighbours):
        above = [places[n][1] for n in neighbours[name] if n in places and places[n][0] != rows[name]]
        column = above[0] if above else 1 + max((c for _, c in places.values()), default=-1)
        while (rows[name], column) in places.values():
            column += 1
        places[name] = (rows[name], column)
    return places


def _falls(plant: PlantDescription) -> list[tuple[str, str]]:
    """(upper, lower) tank for every flow in free fall and every overflow."""
    flows = [(c.source, c.target) for c in plant.flow_components() if c.falls and c.target != OUTSIDE]
    return flows + [(t.name, t.overflow_to) for t in plant.tanks if t.overflow_to not in (OUTSIDE, t.name)]


def _floors(plant: PlantDescription) -> dict[str, str]:
    """The first tank with the same zero of the level, for every tank: a flow that depends on both levels has one."""
    floors = {t.name: t.name for t in plant.tanks}
    for c in plant.flow_components():
        if c not in plant.metered_flows() and not c.falls and OUTSIDE not in (c.source, c.target):
            lower = floors[c.target]
            floors = {name: floors[c.source] if floor == lower else floor for name, floor in floors.items()}
    return floors


def _rows(names: Iterable[str], falls: list[tuple[str, str]]) -> dict[str, int]:
    """Length of the longest path down to each tank; cycles are cut after as many steps as there are tanks."""
    rows = dict.fromkeys(names, 0)
    for _ in range(len(rows) - 1):
        for above, below in falls:
            rows[below] = min(max(rows[below], rows[above] + 1), len(rows) - 1)
    return rows


def _neighbours(plant: PlantDescription) -> dict[str, list[str]]:
    joined: dict[str, list[str]] = {t.name: [] for t in plant.tanks}
    ends = [(c.source, c.target) for c in plant.flow_components() if OUTSIDE not in (c.source, c.target)]
    for a, b in ends + _falls(plant):
        if b not in joined[a]:
            joined[a].append(b)
            joined[b].append(a)
    return joined


def _walk(plant: PlantDescription, neighbours: dict[str, list[str]]) -> list[str]:
    """The tanks in order along their connections, each chain starting at one of its ends."""
    ends_first = sorted((t.name for t in plant.tanks), key=lambda name: len(neighbours[name]) > 1)
    order: dict[str, None] = {}
    for start in ends_first:
        pending = [start]
        while pending:
            name = pending.pop()
            if name not in order:
                order[name] = None
                pending += [n for n in reversed(neighbours[name]) if n not in order]
    return list(order)


Point = tuple[float, float]
POINTS, LINE = 9.0, 0.2  # size of the letters, points; height of a line in units of the drawing
LetterStyle = tuple[str, str, str]  # text, colour, weight
Box = tuple[float, float, float, float]  # left, bottom, right, top


@dataclass(frozen=True)
class TextBlock:
    """Lines of text at a point. ha: left, center or right of it. down: the first line lies at the point and further
    ones below; otherwise the last line lies there and the others above. unit: points per unit of the drawing.
    """

    lines: Sequence[LetterStyle]
    point: Point
    ha: str
    down: bool
    unit: float

    @property
    def box(self) -> Box:
        x, y = self.point
        width = max(text_width(text, weight) for text, _, weight in self.lines) / self.unit
        left = x - width * {"left": 0.0, "center": 0.5, "right": 1.0}[self.ha]
        height = LINE * len(self.lines)
        return left, y - height if self.down else y, left + width, y if self.down else y + height

    def placed_lines(self) -> list[tuple[Point, LetterStyle]]:
        """Each line with the point of its upper end if `down`, else of its lower end."""
        (x, y), step = self.point, -LINE if self.down else LINE
        return [((x, y + k * step), line) for k, line in enumerate(self.lines[:: 1 if self.down else -1])]


@lru_cache(maxsize=1024)  # a drawing asks for the width of each line again and again
def text_width(text: str, weight: str = "normal") -> float:
    """Width of a text in points."""
    path = TextPath((0.0, 0.0), text, size=POINTS, prop=FontProperties(weight=weight), usetex=False)
    return float(path.get_extents().width) if text.strip() else 0.0


def separated(blocks: Iterable[TextBlock], obstacles: Iterable[Box] = ()) -> list[TextBlock]:
    """The blocks in order, each moved down (or up, if not `down`) until it is free of obstacles and earlier blocks."""
    taken, placed = list(obstacles), []
    for block in blocks:
        while hit := [box for box in taken if _overlap(box, block.box)]:
            beyond = min(box[1] for box in hit) - GAP if block.down else max(box[3] for box in hit) + GAP
            block = replace(block, point=(block.point[0], beyond))
        taken.append(block.box)
        placed.append(block)
    return placed


GAP = 0.04
"""Between two blocks, in units of the drawing."""


def _overlap(a: Box, b: Box) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


LETTERS, LONGEST = 9, 40  # letters per line, and per effect
LEAST_SHARE = 0.005  # of a probability that is written


@dataclass(frozen=True)
class Overlay:
    """The diagnosis to draw. levels: tank -> m. marks: location -> texts of diagnosed effects. probabilities: location
    -> probability of a discrepancy there (0 to 1), drawn as strength of colour.
    """

    levels: Mapping[str, float] = field(default_factory=dict)
    marks: Mapping[str, Sequence[str]] = field(default_factory=dict)
    probabilities: Mapping[str, float] = field(default_factory=dict)

    def lines(self, name: str, colour: str) -> list[LetterStyle]:
        """The lines at a component: its effects, one below the other, in this colour, and the probability."""
        marks = self.marks.get(name, ())
        lines: list[LetterStyle] = []
        for text in marks:
            first, *others = wrap(short(text, LONGEST), LETTERS, break_long_words=False) or [""]
            bullet = "• " if len(marks) > 1 else ""
            lines += [(line, colour, "bold") for line in (bullet + first, *others)]
        share = self.probabilities.get(name, 0.0)
        return [*lines, (probability_words(share), INK, "bold")] if share >= LEAST_SHARE else lines

    def opacity(self, name: str) -> float:
        """Opacity of the colour at a location, by the cube of its probability, so that certain ones stand out."""
        return 0.3 * self.probabilities.get(name, 0.0) ** 3


def level_text(level: float) -> str:
    """A level to about one millimetre."""
    unit, scale = shown_unit("m")
    return f"{scale * level:.{max(0, 3 - int(np.log10(scale)))}f} {unit}"


def longest_piece(points: Sequence[Point]) -> tuple[Point, Point]:
    """Ends of the longest straight piece of a line."""
    return max(pairwise(points), key=lambda piece: abs(piece[0][0] - piece[1][0]) + abs(piece[0][1] - piece[1][1]))


def direction(start: Point, end: Point) -> Point:
    """Unit vector from start to end."""
    length = math.dist(start, end)
    return (end[0] - start[0]) / length, (end[1] - start[1]) / length


def arrow_head(tip: Point, direction: Point, colour: str) -> Polygon:
    """A triangle with its tip there that points in a direction."""
    (x, y), (dx, dy) = tip, direction
    base = [(x - 0.14 * dx + side * dy, y - 0.14 * dy - side * dx) for side in (-0.08, 0.08)]
    return Polygon([*base, (x, y)], facecolor=colour, edgecolor="none", zorder=4)
