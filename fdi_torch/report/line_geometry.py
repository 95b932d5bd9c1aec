"""Geometry of the lines in the drawing of a rig: their longest piece, their direction, and arrow heads."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

from matplotlib.patches import Polygon

Point = tuple[float, float]


def longest_piece(points: Sequence[Point]) -> tuple[Point, Point]:
    """Ends of the longest straight piece of a line."""
    return max(pairwise(points), key=lambda piece: abs(piece[0][0] - piece[1][0]) + abs(piece[0][1] - piece[1][1]))


def direction(start: Point, end: Point) -> Point:
    """Unit vector from start to end."""
    length = math.hypot(end[0] - start[0], end[1] - start[1])
    return (end[0] - start[0]) / length, (end[1] - start[1]) / length


def arrow_head(tip: Point, direction: Point, colour: str) -> Polygon:
    """A triangle with its tip there that points in a direction."""
    (x, y), (dx, dy) = tip, direction
    base = [(x - 0.14 * dx + side * dy, y - 0.14 * dy - side * dx) for side in (-0.08, 0.08)]
    return Polygon([*base, (x, y)], facecolor=colour, edgecolor="none", zorder=4)
