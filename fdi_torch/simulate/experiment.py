"""Experiment: what is imposed on a plant, laid out in integration steps, and when it is read."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.capacity import expect_room
from fdi_torch.plant.signals import CumulativeSignal
from fdi_torch.recording import Hold, Recording
from fdi_torch.simulate.own_steps import OwnSteps

BLOCK = 1 << 17


@dataclass(frozen=True)
class Experiment:
    """Inputs and sample times on a grid of steps.

    nodes (K+1,) s: the ends of the integration steps, which hit every switch of a held input they can.
    inputs (K, channels): each channel's exact mean over each step. signal: the same for any delayed interval.
    sample_times (S,) s; sample k lies at share `sample_share` (0..1] of step `sample_step` (the first at 0 of step 0).
    resolution: the time below which roots and rims are drawn smooth, s; the longest step, or that of `own`.
    own: None, or how each lane divides the steps by itself.
    """

    nodes: Tensor
    inputs: Tensor
    signal: CumulativeSignal
    sample_times: Tensor
    sample_step: Tensor
    sample_share: Tensor
    resolution: Tensor
    own: OwnSteps | None = None

    @property
    def steps(self) -> Tensor:
        return torch.diff(self.nodes)

    def mapped(self, make: Callable[[Tensor], Tensor]) -> Experiment:
        """The same experiment with another kind of tensor for all that a plant's equations see of it."""
        return replace(
            self,
            nodes=make(self.nodes),
            inputs=make(self.inputs),
            sample_times=make(self.sample_times),
            sample_share=make(self.sample_share),
            resolution=make(self.resolution),
        )

    @property
    def sample_intervals(self) -> Tensor:
        """How long before each sample the one before it was, (S,) s. The first: since the start, or where it is the
        start, as the second; a single one as the first step.
        """
        times = self.sample_times
        if float(self.sample_share[0]) > 0.0:
            return torch.diff(times, prepend=self.nodes[:1])
        first = times[1] - times[0] if len(times) > 1 else self.nodes[1] - self.nodes[0]
        return torch.diff(times, prepend=times[:1] - first)


def lay_out(recording: Recording, channels: tuple[str, ...], step: float, own: OwnSteps | None = None) -> Experiment:
    """The experiment that a recording was, in steps no longer than `step` (s), which lanes divide into `own` ones.

    channels: the plant's input channels, by name. Raises ValueError where the recording lacks one or does not know it.
    """
    if not step > 0:
        raise ValueError(f"expected a positive integration step, got {step} s")
    if len(recording) < 2:
        raise ValueError(f"{recording.source}: expected at least two samples, got {len(recording)}")
    inputs = _select(recording, channels)
    time = recording.time - recording.time[0]
    nodes = grid_nodes(time, inputs, recording.hold, step, every=own is not None)
    signal = CumulativeSignal(time, inputs, recording.hold)
    starts, steps = nodes[:-1], torch.diff(nodes)
    means = torch.empty(len(starts), len(channels), dtype=time.dtype, device=time.device)
    for block in _blocks(len(starts)):
        for c in range(len(channels)):
            means[block, c] = signal.average(starts[block], steps[block], c)
    index = torch.clamp(torch.searchsorted(nodes, time) - 1, min=0)
    share = (time - nodes[index]) / steps[index]
    return Experiment(
        nodes=nodes,
        inputs=means,
        signal=signal,
        sample_times=time,
        sample_step=index,
        sample_share=share,
        resolution=steps.max() if own is None else steps.new_tensor(own.resolution),
        own=own,
    )


def grid_nodes(time: Tensor, inputs: Tensor, hold: Hold, step: float, every: bool = False) -> Tensor:
    """Step ends (K+1,) s from the first to the last sample, time (S,) s: at switches of inputs (S, M), and at samples
    where these are not denser than `step` s.

    every: at every sample. Switches that come faster than half a step are averaged over instead.
    """
    wanted, span = torch.ones_like(time, dtype=torch.bool), float(time[-1] - time[0])
    if hold == "zero_order":
        changed = torch.diff(inputs, dim=0).abs().sum(dim=1) > 0
        wanted[1:] = changed
        if int(changed.sum()) * step > 2.0 * span:
            wanted[1:] = False
    dense = not every and span / (len(time) - 1) < 0.999 * step
    anchors = time[wanted] if dense and hold == "zero_order" else time
    if dense and hold == "linear":
        anchors = time[:1]
    ends = torch.cat([time[:1], anchors, time[-1:]]).unique()
    gaps = torch.diff(ends)
    needed = torch.ceil(gaps / step - 1e-9).clamp(min=1)
    total = float(needed.sum())
    what = f"{total:.3g} integration steps of {step:g} s through {span:g} s"
    expect_room((2 + inputs.shape[1]) * total, what, "choose a longer step")
    counts = needed.to(torch.int64)
    after = torch.cumsum(counts, 0)
    nodes = torch.empty(int(after[-1]) + 1, dtype=time.dtype, device=time.device)
    nodes[-1] = ends[-1]
    for block in _blocks(len(nodes) - 1):
        number = torch.arange(block.start, block.stop, device=time.device)
        gap = torch.searchsorted(after, number, right=True)
        within = (number - (after[gap] - counts[gap])).to(time.dtype)
        nodes[block] = ends[gap] + gaps[gap] * within / counts[gap]
    return nodes


def _blocks(count: int) -> Iterator[slice]:
    """0 .. count in pieces, so that what is worked out on the way to millions of steps takes little memory."""
    return (slice(first, min(first + BLOCK, count)) for first in range(0, count, BLOCK))


def _select(recording: Recording, channels: tuple[str, ...]) -> Tensor:
    columns = []
    for channel in channels:
        if channel not in recording.input_names:
            known = ", ".join(recording.input_names) or "none"
            raise ValueError(f"{recording.source}: expected an input '{channel}', got {known}; map the column to it")
        columns.append(recording.inputs[:, recording.input_names.index(channel)])
    if not columns:
        return recording.time.new_zeros(len(recording), 0)
    inputs = torch.stack(columns, dim=1)
    if not bool(torch.isfinite(inputs).all()):
        row = int((~torch.isfinite(inputs)).any(dim=1).nonzero()[0])
        raise ValueError(
            f"{recording.source}: expected known inputs, got an unknown one at {float(recording.time[row]):g} s; "
            "mask that stretch or cut the recording there"
        )
    return inputs
