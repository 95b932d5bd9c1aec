"""Coordinates in which narrow curved ridges of a likelihood are straight, for samplers that move along lines.

Where the readings determine only a product such as C_d (1 - b), the posterior is a narrow curved ridge. With i the
parameter along it and p_j(x) the value of parameter j in the profile likelihood of i at x, the coordinates are

    phi_i = theta_i,    phi_j = theta_j - p_j(theta_i) + p_j(estimate_i)

Their Jacobian determinant is 1 for any functions p_j, so that the density needs no correction; an inaccurate profile
costs speed alone. Offsets of several ridges add up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class RidgeCoordinates:
    """The map between parameters theta (*batch, P) and coordinates phi (*batch, P).

    along: indices of the parameters along the ridges. x (K,) and offset (K, P) of each: values of that parameter, and
    by how much the others then differ from the estimate (0 for those of `along`).
    """

    along: tuple[int, ...]
    x: tuple[np.ndarray, ...]
    offset: tuple[np.ndarray, ...]

    def theta(self, phi: Float[Tensor, "*batch P"]) -> Float[Tensor, "*batch P"]:
        return phi + self._offset(phi)

    def phi(self, theta: Float[Tensor, "*batch P"]) -> Float[Tensor, "*batch P"]:
        return theta - self._offset(theta)

    def information(self, theta: Float[Tensor, " P"], information: Float[Tensor, "P P"]) -> Float[Tensor, "P P"]:
        """Fisher information of the coordinates, from that of the parameters at theta."""
        jacobian = torch.eye(len(theta)).to(theta)
        for index, (_, slope) in zip(self.along, self._curves(theta), strict=True):
            jacobian[:, index] += slope
        return jacobian.mT @ information @ jacobian

    def _offset(self, at: Tensor) -> Tensor:
        return sum((value for value, _ in self._curves(at)), torch.zeros_like(at))

    def _curves(self, at: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Offsets (*batch, P) of each ridge and their slopes, continued along straight lines beyond its profile."""
        curves = []
        for index, x, offset in zip(self.along, self.x, self.offset, strict=True):
            from scipy.interpolate import PchipInterpolator  # it takes 0.3 s to load, and few jobs draw

            curve, where = PchipInterpolator(x, offset), at[..., index].cpu().numpy()
            inside = np.clip(where, x[0], x[-1])
            slope = curve.derivative()(inside)
            value = curve(inside) + slope * (where - inside)[..., None]
            curves.append((torch.as_tensor(value).to(at), torch.as_tensor(slope).to(at)))
        return curves


UNCHANGED = RidgeCoordinates((), (), ())
