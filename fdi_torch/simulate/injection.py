"""Corrections fed into a simulation at its samples: what makes an observer of a plant."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.plant.signals import CumulativeSignal
from fdi_torch.recording import Hold
from fdi_torch.simulate.experiment import Experiment


@dataclass(frozen=True)
class Injection:
    """After each sample level += gain (reading - prediction), never below zero.

    gains (S, tanks, sensors) for all lanes, or (lanes, S, tanks, sensors). start (lanes, tanks): levels at the
    beginning; memory (lanes, M): what actuators and then sensors remember there, settled where None.
    """

    gains: Tensor
    start: Tensor
    memory: Tensor | None = None

    @property
    def stride(self) -> int:
        return 0 if self.gains.dim() == 3 else self.gains[0].numel()

    def tables(self, like: Tensor) -> dict[str, Tensor | None]:
        """As the compiled engine takes them."""
        memory = None if self.memory is None or not self.memory.shape[-1] else self.memory.to(like).contiguous()
        return {
            "gains": self.gains.to(like).contiguous(),
            "start": self.start.to(like).contiguous(),
            "start_memory": memory,
        }


def lay_out_samples(
    time: Tensor, inputs: Tensor, hold: Hold, step: float, from_first: bool = True, resolution: float | None = None
) -> Experiment:
    """Every sample at the end of a step no longer than `step` (s), on the clock of `time` (S,); inputs (S, channels).

    from_first: whether the first sample is one to be read, or only where the run begins. A single sample is read and
    nothing else. resolution: how sharply roots and rims are drawn, s; by default by the longest of the steps.
    """
    if len(time) == 1:
        time, inputs = torch.cat([time, time + step]), inputs.expand(2, -1)
        beyond = lay_out_samples(time, inputs, "zero_order", step, resolution=resolution)
        return replace(
            beyond, sample_times=time[:1], sample_step=beyond.sample_step[:1], sample_share=beyond.sample_share[:1]
        )
    gaps = torch.diff(time)
    counts = torch.ceil(gaps / step - 1e-9).clamp(min=1).to(torch.int64)
    which = torch.repeat_interleave(torch.arange(len(gaps)), counts)
    ends = torch.cumsum(counts, 0)
    within = torch.arange(len(which)) - (ends - counts)[which]
    share = within.to(time.dtype) / counts[which]
    nodes = torch.cat([time[which] + gaps[which] * share, time[-1:]])
    if hold == "zero_order":
        means = inputs[which]
    else:
        middle = (share + 0.5 / counts[which]).unsqueeze(-1)
        means = inputs[which] + middle * (inputs[which + 1] - inputs[which])
    steps, shares = ends - 1, torch.ones_like(gaps)
    if from_first:
        steps = torch.cat([steps.new_zeros(1), steps])
        shares = torch.cat([shares.new_zeros(1), shares])
    return Experiment(
        nodes=nodes,
        inputs=means,
        signal=CumulativeSignal(time, inputs, hold),
        sample_times=time if from_first else time[1:],
        sample_step=steps,
        sample_share=shares,
        resolution=torch.diff(nodes).max() if resolution is None else nodes.new_tensor(resolution),
    )


def expect_injectable(experiment: Experiment, injection: Injection, memory: int) -> None:
    """Raises ValueError where a sample lies within a step, whose correction would come too late, or where what is
    remembered is not of `memory` numbers.
    """
    shares = experiment.sample_share
    if bool(((shares > 0.0) & (shares < 1.0)).any()):
        raise ValueError("expected every sample at the end of a step, got one within; use lay_out_samples")
    if injection.memory is not None and injection.memory.shape[-1] != memory:
        raise ValueError(f"expected {memory} remembered numbers a lane, got {injection.memory.shape[-1]}")
