"""Merge consecutive windows in which a fault is present into one time interval (stretch) with one size."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from fdi_torch.estimate.windows import Window, WindowFault


@dataclass(frozen=True)
class Stretch:
    """Time interval in which a fault was present without interruption.

    start, stop: s. size, std: merged estimate and standard error, in `unit`; std is infinite if most windows have no
    finite one. flow: mean change of flow, m^3/s; None if the fault does not change a flow.
    """

    name: str
    start: float
    stop: float
    size: float
    std: float
    flow: float | None
    unit: str = "1"


def stretches_of(windows: Sequence[Window]) -> list[Stretch]:
    """All intervals in which faults are present, ordered by fault, then by time."""
    intervals = []
    for k, first in enumerate(windows[0].faults if windows else ()):
        run: list[Window] = []
        for window in [*windows, None]:
            adjacent = window is not None and (not run or run[-1].start < window.start <= run[-1].stop + 1e-6)
            if window is not None and adjacent and window.faults[k].state == "present":
                run.append(window)
                continue
            if run:
                intervals.append(_merged(first.name, [w.faults[k] for w in run], run[0].start, run[-1].stop))
            run = [window] if window is not None and window.faults[k].state == "present" else []
    return intervals


def _merged(name: str, estimates: Sequence[WindowFault], start: float, stop: float) -> Stretch:
    """Merge the estimates of one fault in consecutive windows.

    The size is the mean m = sum w_i s_i, weighted by flow, with variance sum w_i^2 (std_i^2 + (s_i - m)^2). Windows
    with an infinite standard error are excluded; if they are the majority, the result is the largest size, with
    std = inf.
    """
    flows = [f.flow for f in estimates if f.flow is not None]
    flow = sum(flows) / len(flows) if flows else None
    finite = [f for f in estimates if math.isfinite(f.std)]
    if 2 * len(finite) < len(estimates):
        return Stretch(name, start, stop, max(f.size for f in estimates), math.inf, flow, estimates[0].unit)
    size = torch.tensor([f.size for f in finite], dtype=torch.float64)
    weight = torch.tensor([1.0 if f.flow is None else max(f.flow, 1e-12) for f in finite], dtype=torch.float64)
    weight = weight / weight.sum()
    mean = float((weight * size).sum())
    std_of_window = torch.tensor([f.std for f in finite], dtype=torch.float64)
    std = float(torch.sqrt((weight**2 * (std_of_window**2 + (size - mean) ** 2)).sum()))
    return Stretch(name, start, stop, mean, std, flow, estimates[0].unit)
