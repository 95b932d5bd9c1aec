"""Narrow curved ridges of a likelihood: their directions, and the coordinates in which they are straight."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fdi_torch.estimate.linearisation import Linearise
from fdi_torch.estimate.posterior_draws import range_information
from fdi_torch.estimate.profile import Profile, profile_likelihood
from fdi_torch.estimate.ridge_coordinates import RidgeCoordinates
from fdi_torch.estimate.uncertainty import make_estimate
from fdi_torch.parameters import ParameterSpace

# A direction is a ridge if the information along it, in units of that of each parameter alone, is below this: two
# parameters whose ridge is some 45 times as long as wide.
RIDGE_INFORMATION = 1e-3
# The profile of a ridge reaches 4.9 standard errors to either side, further than draws do, in this number of intervals.
REACH, POINTS = 1.0 - 1e-6, 64


def ridge_coordinates(
    linearise: Linearise, space: ParameterSpace, start: Float[Tensor, " P"], information: Float[Tensor, "P P"]
) -> RidgeCoordinates:
    """The coordinates that straighten the ridges through an estimate `start`; theta itself where there is none.

    linearise: as of `profile_likelihood`. information: Fisher information at `start`, priors included.
    """
    along = ridge_parameters(information + torch.diag(range_information(space, start)))
    estimate = make_estimate(space, start, information)
    names = [space.names[i] for i in along]
    curves = [
        _curve(p, start, along) for p in profile_likelihood(linearise, space, estimate, names, REACH, points=POINTS)
    ]
    return RidgeCoordinates(tuple(along), tuple(x for x, _ in curves), tuple(offset for _, offset in curves))


def ridge_parameters(information: Float[Tensor, "P P"]) -> list[int]:
    """One parameter for each ridge, the largest component of its direction in units of its own information."""
    unit = information.diagonal().rsqrt()
    scaled = information * unit[:, None] * unit[None, :]
    if not bool(torch.isfinite(scaled).all()):
        return []
    values, vectors = torch.linalg.eigh(0.5 * (scaled + scaled.mT))
    along: list[int] = []
    for direction in vectors.T[values < RIDGE_INFORMATION].abs():
        direction[along] = 0.0
        along.append(int(direction.argmax()))
    return along


def _curve(profile: Profile, start: Tensor, along: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Values (K,) of the profiled parameter, strictly increasing, and offsets (K, P) of the others from `start`."""
    fitted = torch.isfinite(profile.ratio)
    x, offset = profile.x[fitted].cpu().numpy(), (profile.theta[fitted] - start).cpu().numpy()
    offset[:, along] = 0.0
    x, first = np.unique(x, return_index=True)
    return x, offset[first]
