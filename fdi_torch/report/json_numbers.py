"""Numbers out of a log's JSON, which may hold anything: what is no number becomes NaN."""

from __future__ import annotations

from typing import Any

import numpy as np


def as_float(value: Any) -> float:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else float("nan")


def as_vector(values: Any) -> np.ndarray:
    return np.array([as_float(value) for value in values])
