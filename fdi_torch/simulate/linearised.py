"""A trajectory with its first derivatives, as fits use it. L lanes, K steps, S samples, C sensors, P parameters."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True, eq=False)
class Linearised:
    """A trajectory, its readings and their first derivatives.

    levels (L, K+1, n) m: the corrected trajectory of the n = `network.order` states, the tanks' levels first; slopes
    (L, K+1, n, P): its sensitivity. readings (L, S, C) and jacobian (L, S, C, P): the same at the sensors. transition
    (L, K, n, n) and gain (L, K, n, n): a disturbance w of the rates over step k adds gain_k w to the next state, and
    transition propagates it. defect (L,): the largest correction of a state, m. origin (L, K+1, n) m: the trajectory
    before the correction, about which it is linearised.
    """

    levels: Tensor
    slopes: Tensor
    readings: Tensor
    jacobian: Tensor
    transition: Tensor
    gain: Tensor
    defect: Tensor
    origin: Tensor

    def lanes(self, which: Tensor) -> Linearised:
        """The selected lanes (indices or a mask)."""
        return Linearised(*(getattr(self, name)[which] for name in self.__dataclass_fields__))

    def replaced(self, which: Tensor, new: Linearised) -> Linearised:
        """The trajectory, with the lanes at indices `which` replaced by those of `new`."""
        if len(which) == len(self.defect):
            return new
        names = self.__dataclass_fields__
        return Linearised(*(getattr(self, n).index_copy(0, which, getattr(new, n)) for n in names))
