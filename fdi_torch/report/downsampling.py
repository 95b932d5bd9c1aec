"""Downsampling of long signals for drawing, without visible change."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

BINS = 400


def thinned(time: np.ndarray, values: np.ndarray, bins: int = BINS) -> tuple[np.ndarray, np.ndarray]:
    """A signal (T,) reduced to the minimum and maximum of each of `bins` segments, in order, so that spikes remain.

    A segment without finite values becomes a gap (NaN).
    """
    if len(time) <= 2 * bins:
        return time, values
    kept = extremes(values, bins)
    return time[kept], values[kept]


def extremes(values: np.ndarray, bins: int) -> np.ndarray:
    """Indices of the minimum and maximum of each of `bins` segments of a signal (T,), T >= bins.

    Of a segment without finite values the first sample is taken.
    """
    edges = np.linspace(0, len(values), bins + 1).astype(int)
    missing, finite = np.isnan(values), np.isfinite(values)
    low, high = np.where(missing, np.inf, values), np.where(missing, -np.inf, values)
    kept: list[int] = []
    for first, last in pairwise(edges.tolist()):
        ends = {int(low[first:last].argmin()), int(high[first:last].argmax())} if finite[first:last].any() else {0}
        kept += sorted(first + end for end in ends)
    return np.array(kept)


def corner_points(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The corners of a signal (T,) that is constant between changes."""
    if not len(time):
        return time, values
    changes = np.flatnonzero(values[1:] != values[:-1]) + 1
    corners = np.unique(np.concatenate(([0], changes, [len(time) - 1])))
    return time[corners], values[corners]
