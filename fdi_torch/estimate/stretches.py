"""Windows in which a fault is present one after another are one stretch: its beginning, its end and its size."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from fdi_torch.estimate.windows import Window, WindowFault


@dataclass(frozen=True)
class Stretch:
    """Consecutive windows in which a fault was present: start, stop in s; size and std, in `unit`, of all together (std
    infinite where the size is beyond its range in each); flow (m^3/s) at the mean levels.
    """

    name: str
    start: float
    stop: float
    size: float
    std: float
    flow: float | None
    unit: str = "1"


def stretches_of(windows: Sequence[Window]) -> list[Stretch]:
    """Consecutive windows in which a fault is present, as one: by fault, then in time."""
    found = []
    for k, first in enumerate(windows[0].faults if windows else ()):
        row: list[Window] = []
        for window in [*windows, None]:
            goes_on = window is not None and (not row or row[-1].start < window.start <= row[-1].stop + 1e-6)
            if window is not None and goes_on and window.faults[k].state == "present":
                row.append(window)
                continue
            if row:
                found.append(_joined(first.name, [w.faults[k] for w in row], row[0].start, row[-1].stop))
            row = [window] if window is not None and window.faults[k].state == "present" else []
    return found


def _joined(name: str, each: Sequence[WindowFault], start: float, stop: float) -> Stretch:
    """The size of the windows together, those in which more water flowed counting for more; its error has their own
    errors and their scatter. Windows whose size is beyond its range have no say in it, unless they are most.
    """
    flows = [f.flow for f in each if f.flow is not None]
    flow = sum(flows) / len(flows) if flows else None
    known = [f for f in each if math.isfinite(f.std)]
    if 2 * len(known) < len(each):
        return Stretch(name, start, stop, max(f.size for f in each), math.inf, flow, each[0].unit)
    size = torch.tensor([f.size for f in known], dtype=torch.float64)
    weight = torch.tensor([1.0 if f.flow is None else max(f.flow, 1e-12) for f in known], dtype=torch.float64)
    weight = weight / weight.sum()
    mean = float((weight * size).sum())
    own = torch.tensor([f.std for f in known], dtype=torch.float64)
    std = float(torch.sqrt((weight**2 * (own**2 + (size - mean) ** 2)).sum()))
    return Stretch(name, start, stop, mean, std, flow, each[0].unit)
