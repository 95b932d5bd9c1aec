"""One recording of a plant linearised about a trajectory: changes of rates to changes of readings, and back."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from fdi_torch.gap.forcing import Forcing
from fdi_torch.simulate.collocation import Collocation
from fdi_torch.simulate.linearised import Linearised
from fdi_torch.simulate.output_map import LinearisedOutputs
from fdi_torch.simulate.scan import product, scan_in_time


@dataclass(frozen=True)
class RecordingLinearisation:
    """One recording linearised about levels (1, K+1, tanks). rows: its samples among all."""

    engine: Collocation
    theta: Tensor
    linearised: Linearised
    forcing: Forcing
    rows: slice

    @property
    def middle(self) -> Tensor:
        nodes = self.engine.experiment.nodes
        return 0.5 * (nodes[1:] + nodes[:-1])

    @cached_property
    def outputs(self) -> LinearisedOutputs:
        """The sensors linearised at the levels."""
        return self.engine.look(self.linearised.levels, self.theta)

    def to_readings(self, rates: Tensor) -> Tensor:
        """Map changes of the rates (n, M, K) to changes of the readings (S, C, M)."""
        gain, transition = self.linearised.gain.permute(0, 2, 3, 1), self.linearised.transition.permute(0, 2, 3, 1)
        paths = scan_in_time(transition, rates.unsqueeze(0), rates.new_zeros(1, *rates.shape[:2]), gain)
        return self.outputs.along(paths, [-1] * rates.shape[1])[0].permute(2, 0, 1)

    def to_rates(self, weights: Tensor) -> Tensor:
        """The transpose of `to_readings`: weights (S, C, M) of the readings -> weights of the rates (n, M, K)."""
        order, columns = self.linearised.gain.shape[-1], weights.shape[-1]
        paths = weights.new_zeros(1, order, columns, self.linearised.levels.shape[1], requires_grad=True)
        readings = self.outputs.along(paths, [-1] * columns)
        # The gradient of a scalar: PyTorch imports SymPy, which takes a second, to check weights given apart.
        (by_path,) = torch.autograd.grad((readings[0] * weights.permute(1, 2, 0)).sum(), paths)
        back, gain = self.linearised.transition.permute(0, 3, 2, 1).flip(-1), self.linearised.gain.permute(0, 3, 2, 1)
        by_level = scan_in_time(back, by_path[..., :-1].flip(-1), by_path[..., -1]).flip(-1)
        return product(gain, by_level[..., 1:])[0]
