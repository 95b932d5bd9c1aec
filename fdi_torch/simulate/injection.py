"""Output injection: measurement feedback at the samples of a simulation, which makes it an observer of the plant."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from fdi_torch.plant.signals import CumulativeSignal
from fdi_torch.recording import Hold
from fdi_torch.simulate.experiment import Experiment


@dataclass(frozen=True)
class Injection:
    """After each sample: state <- state + gain (reading - prediction), with no level below zero.

    gains (S, order, sensors) for all lanes, or (lanes, S, order, sensors), m per unit of the reading. start: initial
    state (lanes, order), m, or initial levels (lanes, tanks) with the effects in steady state. memory (lanes, M):
    initial memory of the actuators and then of the sensors; steady state if None.
    """

    gains: Tensor
    start: Tensor
    memory: Tensor | None = None

    @property
    def stride(self) -> int:
        return 0 if self.gains.dim() == 3 else self.gains[0].numel()

    def tables(self, like: Tensor) -> dict[str, Tensor | None]:
        """The arrays for the compiled engine."""
        memory = None if self.memory is None or not self.memory.shape[-1] else self.memory.to(like).contiguous()
        return {
            "gains": self.gains.to(like).contiguous(),
            "start": self.start.to(like).contiguous(),
            "start_memory": memory,
        }


def lay_out_samples(
    time: Float[Tensor, " S"],
    inputs: Float[Tensor, "S channels"],
    hold: Hold,
    step: float,
    from_first: bool = True,
    resolution: float | None = None,
) -> Experiment:
    """An experiment with every sample at the end of a step of at most `step` s; time (S,) s, inputs (S, channels).

    from_first: whether the first sample is used, or only marks the start. A single sample is read without simulation.
    resolution: time scale of the smoothing of square roots and rims, s; by default the longest step.
    """
    if len(time) == 1:
        time, inputs = torch.cat([time, time + step]), inputs.expand(2, -1)
        extended = lay_out_samples(time, inputs, "zero_order", step, resolution=resolution)
        return replace(
            extended,
            sample_times=time[:1],
            sample_step=extended.sample_step[:1],
            sample_share=extended.sample_share[:1],
        )
    gaps = torch.diff(time)
    counts = torch.ceil(gaps / step - 1e-9).clamp(min=1).to(torch.int64)
    interval = torch.repeat_interleave(torch.arange(len(gaps)), counts)
    ends = torch.cumsum(counts, 0)
    within = torch.arange(len(interval)) - (ends - counts)[interval]
    share = within.to(time.dtype) / counts[interval]
    nodes = torch.cat([time[interval] + gaps[interval] * share, time[-1:]])
    if hold == "zero_order":
        means = inputs[interval]
    else:
        midpoint = (share + 0.5 / counts[interval]).unsqueeze(-1)
        means = inputs[interval] + midpoint * (inputs[interval + 1] - inputs[interval])
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
    """Raises ValueError if a sample lies within a step, or if the injected memory does not have `memory` numbers per
    lane.
    """
    shares = experiment.sample_share
    if bool(((shares > 0.0) & (shares < 1.0)).any()):
        raise ValueError("expected every sample at the end of a step, got one within; use lay_out_samples")
    if injection.memory is not None and injection.memory.shape[-1] != memory:
        raise ValueError(f"expected {memory} memory states per lane, got {injection.memory.shape[-1]}")
