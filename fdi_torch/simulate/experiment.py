"""Experiment: the inputs of a plant on a grid of integration steps, and its sample times."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from fdi_torch.capacity import expect_room
from fdi_torch.plant.signals import CumulativeSignal
from fdi_torch.recording import Hold, Recording
from fdi_torch.simulate.step_control import StepControl

BLOCK = 1 << 17


@dataclass(frozen=True)
class Experiment:
    """Inputs and sample times on a grid of integration steps.

    nodes (K+1,) s: the ends of the steps, which coincide with the switches of a held input where possible. inputs (K,
    channels): exact mean of each channel over each step; signal: the same for any delayed interval. sample_times (S,)
    s; sample k is at the fraction `sample_share` (0..1] of step `sample_step` (the first one at 0 of step 0).
    resolution: time scale of the smoothing of square roots and rims, s; the longest step, or that of `step_control`;
    one per step (K,) where some steps are divided.
    step_control: None for fixed steps, or the control by which each lane divides the steps.
    """

    nodes: Tensor
    inputs: Tensor
    signal: CumulativeSignal
    sample_times: Tensor
    sample_step: Tensor
    sample_share: Tensor
    resolution: Tensor
    step_control: StepControl | None = None

    @property
    def steps(self) -> Tensor:
        return torch.diff(self.nodes)

    @property
    def steps_text(self) -> str:
        """The length of the steps in words, such as 'steps of 5 s' or 'steps of 3.33 to 5 s'."""
        shortest, longest = (f"{float(end):.3g}" for end in torch.aminmax(self.steps))
        length = longest if shortest == longest else f"{shortest} to {longest}"
        return f"steps of {length} s" + ("" if self.step_control is None else ", divided where accuracy needs it")

    def mapped(self, make: Callable[[Tensor], Tensor]) -> Experiment:
        """The same experiment with all tensors that enter a plant's equations mapped by `make`."""
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
        """Time since the preceding sample, (S,) s.

        The first sample has none before it: its interval is the time since the start or, if it lies at the start, the
        interval that follows it (a step of the grid if there is only one sample).
        """
        times = self.sample_times
        if float(self.sample_share[0]) > 0.0:
            return torch.diff(times, prepend=self.nodes[:1])
        first = times[1] - times[0] if len(times) > 1 else self.nodes[1] - self.nodes[0]
        return torch.diff(times, prepend=times[:1] - first)


def lay_out(
    recording: Recording, channels: tuple[str, ...], step: float, step_control: StepControl | None = None
) -> Experiment:
    """The experiment of a recording, in steps of at most `step` s, which each lane may divide by `step_control`.

    channels: names of the plant's input channels. Raises ValueError if the recording lacks one or has unknown values in
    it.
    """
    expect_step(step)
    if len(recording) < 2:
        raise ValueError(f"{recording.source}: expected at least two samples, got {len(recording)}")
    inputs = _select(recording, channels)
    time = recording.time - recording.time[0]
    nodes = grid_nodes(time, inputs, recording.hold, step, every=step_control is not None)
    longest = torch.diff(nodes).max()
    resolution = longest if step_control is None else longest.new_tensor(step_control.resolution)
    return _on_nodes(nodes, CumulativeSignal(time, inputs, recording.hold), time, resolution, step_control)


def expect_step(step: float) -> None:
    """Raises ValueError unless an integration step, s, is a positive number."""
    if isinstance(step, str):
        raise ValueError(f"expected the integration step as a number of seconds, got '{step}'; leave out the unit")
    if not step > 0:
        raise ValueError(f"expected a positive integration step, got {step:g} s")


def divided(experiment: Experiment, counts: Int[Tensor, " K"]) -> Experiment:
    """The experiment with each step k, and its resolution, divided by counts[k]."""
    step = torch.repeat_interleave(torch.arange(len(counts)), counts)
    within = torch.arange(len(step)) - (torch.cumsum(counts, 0) - counts)[step]
    starts = experiment.nodes[step] + experiment.steps[step] * within / counts[step]
    nodes = torch.cat([starts, experiment.nodes[-1:]])
    resolution = experiment.resolution.expand_as(counts)[step] / counts[step]
    return _on_nodes(nodes, experiment.signal, experiment.sample_times, resolution, experiment.step_control)


def _on_nodes(
    nodes: Tensor, signal: CumulativeSignal, times: Tensor, resolution: Tensor, step_control: StepControl | None
) -> Experiment:
    """The experiment with step ends `nodes` (K+1,) and samples at `times` (S,), s."""
    starts, steps = nodes[:-1], torch.diff(nodes)
    means = torch.empty(len(starts), signal.channels, dtype=times.dtype, device=times.device)
    for block in _blocks(len(starts)):
        for c in range(signal.channels):
            means[block, c] = signal.average(starts[block], steps[block], c)
    index = torch.clamp(torch.searchsorted(nodes, times) - 1, min=0)
    return Experiment(
        nodes=nodes,
        inputs=means,
        signal=signal,
        sample_times=times,
        sample_step=index,
        sample_share=(times - nodes[index]) / steps[index],
        resolution=resolution,
        step_control=step_control,
    )


def grid_nodes(
    time: Float[Tensor, " S"], inputs: Float[Tensor, "S M"], hold: Hold, step: float, every: bool = False
) -> Float[Tensor, " nodes"]:
    """Step ends (K+1,) s from the first to the last sample.

    A step ends at every switch of the inputs (S, M), and at every sample of time (S,) unless samples are denser than
    `step` s. every: end a step at every sample even then. Inputs that switch faster than half a step on average are
    averaged over steps.
    """
    is_anchor, span = torch.ones_like(time, dtype=torch.bool), float(time[-1] - time[0])
    if hold == "zero_order":
        switched = torch.diff(inputs, dim=0).abs().sum(dim=1) > 0
        is_anchor[1:] = switched
        if int(switched.sum()) * step > 2.0 * span:
            is_anchor[1:] = False
    dense = not every and span / (len(time) - 1) < 0.999 * step
    anchors = time[is_anchor] if dense and hold == "zero_order" else time
    if dense and hold == "linear":
        anchors = time[:1]
    ends = torch.cat([time[:1], anchors, time[-1:]]).unique()
    gaps = torch.diff(ends)
    needed = torch.ceil(gaps / step - 1e-9).clamp(min=1)
    total = float(needed.sum())
    what = f"{total:.3g} integration steps of {step:g} s through {span:g} s"
    expect_room((2 + inputs.shape[1]) * total, what, "choose a longer step")
    counts = needed.to(torch.int64)
    last_step = torch.cumsum(counts, 0)
    nodes = torch.empty(int(last_step[-1]) + 1, dtype=time.dtype, device=time.device)
    nodes[-1] = ends[-1]
    for block in _blocks(len(nodes) - 1):
        number = torch.arange(block.start, block.stop, device=time.device)
        gap = torch.searchsorted(last_step, number, right=True)
        within = (number - (last_step[gap] - counts[gap])).to(time.dtype)
        nodes[block] = ends[gap] + gaps[gap] * within / counts[gap]
    return nodes


def _blocks(count: int) -> Iterator[slice]:
    """Slices of 0..count that bound the memory of intermediate results for millions of steps."""
    return (slice(first, min(first + BLOCK, count)) for first in range(0, count, BLOCK))


def _select(recording: Recording, channels: tuple[str, ...]) -> Tensor:
    inputs = recording.inputs[:, recording.input_columns(channels)]
    if not bool(torch.isfinite(inputs).all()):
        row = int((~torch.isfinite(inputs)).any(dim=1).nonzero()[0])
        raise ValueError(
            f"{recording.source}: expected a value of every input, got a missing one at {float(recording.time[row]):g} "
            "s; mask that segment or cut the recording there"
        )
    return inputs
