"""The estimators that a study compares, by name, with their meanings. Pages about studies load them without torch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

Estimator = Literal["free", "boxed", "correlation", "linearised", "search"]
ESTIMATORS: Mapping[Estimator, str] = {
    "free": "maximum likelihood without bounds on the parameters",
    "boxed": "maximum likelihood within the bounds",
    "correlation": "maximum correlation of readings and model, the objective of the 2020 paper",
    "linearised": "the best possible with this noise, because it knows the truth",
    "search": "the best of the global search, not refined",
}
