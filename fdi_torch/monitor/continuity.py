"""Samples with gaps, jumping clocks, repetitions and unknown inputs, put into stretches that can be followed."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from fdi_torch.monitor.samples import Samples

GAP = 10.0  # sampling intervals without a sample before the observer starts afresh
USUAL = 0.75
"""Share of the intervals no longer than the usual one: where they are random, ten medians come by chance."""


def continuous(before: Samples, samples: Samples) -> list[tuple[Samples, str]]:
    """The new samples in stretches without a gap, a jump of the clock or unknown inputs, each with a sentence on what
    lies before it, empty where nothing does. A sample that repeats the last one's time is left out.
    """
    known = torch.isfinite(samples.inputs).all(dim=-1)
    steps = torch.diff(torch.cat([before.time, samples.time]))
    usual = float(steps[steps > 0].quantile(USUAL, interpolation="lower")) if bool((steps > 0).any()) else 1.0
    last = float(before.time[-1])
    stretches: list[tuple[list[int], str]] = [([], "")]
    unknown_since: float | None = None
    for k, time in enumerate(samples.time.tolist()):
        if time == last:
            continue
        if not bool(known[k]):
            unknown_since = time if unknown_since is None else unknown_since
            last = time
            continue
        notice = _notice(last, time, usual, unknown_since)
        if notice:
            stretches.append(([], notice))
        stretches[-1][0].append(k)
        last, unknown_since = time, None
    return [(_chosen(samples, kept), notice) for kept, notice in stretches if kept]


def _notice(last: float, time: float, usual: float, unknown_since: float | None) -> str:
    if time < last:
        return f"the clock jumps back by {last - time:g} s; the observer starts afresh on the new time"
    if unknown_since is not None:
        return f"an input is unknown from {unknown_since:g} s to {time:g} s; the observer starts afresh"
    if time - last > GAP * usual:
        return f"no samples for {time - last:g} s; the observer starts afresh"
    return ""


def _chosen(samples: Samples, rows: Sequence[int]) -> Samples:
    index = torch.tensor(list(rows))
    return Samples(samples.time[index], samples.inputs[index], samples.readings[index], samples.hold)


def joined(first: Samples, second: Samples) -> Samples:
    """Samples of one clock, one after the other; how inputs run is as in the second."""
    return Samples(
        torch.cat([first.time, second.time]),
        torch.cat([first.inputs, second.inputs]),
        torch.cat([first.readings, second.readings]),
        second.hold,
    )
