"""Random flows into the tanks of a rig, and noise and drift of its sensors; `kalman.py` has the equations."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Wander:
    """Slow random drift z of one sensor's reading: a stationary process with the correlation, after a time t = x tau,

        exp(-x),    or if smooth (1 + x) exp(-x).

    The rate of a smooth drift is continuous, as with temperature (Rasmussen and Williams, 2006, "Gaussian processes for
    machine learning", equation 4.17). std: of z, reading's unit. correlation_time: tau, s.
    """

    channel: int
    std: float
    correlation_time: float
    smooth: bool = False


# Flow disturbances of one plant have the same causes (pumps, waves, valves, supply) and are of one order of magnitude:
# standard deviation of the logarithm of an intensity, a factor of two.
SCATTER = math.log(2.0)


@dataclass(frozen=True)
class StateNoise:
    """Parameters of the noise model.

    intensity (tanks,): standard deviation of the random flow into each tank at the usual sampling interval, m^3/s; none
    acts on other states.
    correlation_time: of these flows, s; 0: white, with an independent value in each sampling interval.
    scale (C,): factor on the standard deviation of each sensor's noise. wander: drift of one sensor, if any.
    apart: index of a tank whose random flow is not of the same order as the others', if any.
    """

    intensity: Tensor
    correlation_time: float
    scale: Tensor
    wander: Wander | None = None
    apart: int | None = None

    @property
    def tied(self) -> Tensor:
        """Tanks whose random flows are of one order of magnitude, (n,) bool."""
        return torch.tensor([i != self.apart for i in range(len(self.intensity))])

    def scatter(self) -> Tensor:
        """Log intensities of the tied flows less their mean, over SCATTER, (n,); 0 for a flow apart."""
        tied = self.tied
        logarithm = torch.log(self.intensity)
        return torch.where(tied, (logarithm - logarithm[tied].mean()) / SCATTER, 0.0)

    def log_prior(self) -> float:
        """Log prior density of the intensities, against equal ones."""
        return -0.5 * float(self.scatter().square().sum())


@dataclass(frozen=True)
class SensorNoise:
    """Sensor noise: standard deviation (C,) in the reading's unit, and correlation of neighbouring samples (C,).

    The correlation does not depend on the time between the samples, since it is estimated from, and whitened in, their
    sequence (gap/channel_noise.py), whether a sample is a reading or the mean of several.
    """

    std: Tensor
    correlation: Tensor
