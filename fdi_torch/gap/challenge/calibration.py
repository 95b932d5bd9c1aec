"""Is an explanation that was given 90 % right in nine of ten cases?"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

from fdi_torch.gap.challenge.intervals import clopper_pearson

EDGES = (0.0, 0.5, 0.8, 0.95, 0.99, 1.0)


def calibration(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """By the probability that the best explanation was given: how often it is the true one.

    A bin each, where there is any case: from and to, mean probability, hits of cases, exact 95 % interval.
    """
    told = [(float(r["stated"]), bool(r["stated_right"])) for r in rows if r.get("stated") is not None]
    bins = []
    for low, high in pairwise(EDGES):
        inside = [(p, right) for p, right in told if low < p <= high]
        if inside:
            hits = sum(right for _, right in inside)
            mean = math.fsum(p for p, _ in inside) / len(inside)
            share = {"of": len(inside), "hits": hits, "share": hits / len(inside)}
            bins.append(
                {"low": low, "high": high, "stated": mean} | share | {"ci95": clopper_pearson(hits, len(inside))}
            )
    return bins
