"""Forward-mode differentiation with torch, in which every number carries a slope.

Where a slope meets a plain number or a tensor without one, torch (2.13) takes a path through Python that is fifty times
slower than the operation itself. All operands are therefore given a slope of zero beforehand.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd import forward_ad
from torch.overrides import TorchFunctionMode

from fdi_torch.plant.operating_point import Constants, PlaceValues

_ARITHMETIC = {
    name
    for stem in ("add", "sub", "mul", "div", "truediv")
    for name in (stem, f"__{stem}__", f"__r{stem}__", f"__i{stem}__")
} | {"where"}
_FACTORIES = {"zeros_like", "ones_like", "full_like", "new_zeros", "new_ones", "new_full", "new_tensor"}


def with_slope(value: Tensor, slope: Tensor | None = None) -> Tensor:
    """The tensor with this slope (same shape); with a slope of zero if none is given and it has none."""
    if slope is None:
        if not value.is_floating_point() or forward_ad.unpack_dual(value).tangent is not None:
            return value
        value = value.contiguous()  # torch refuses expanded tensors
        slope = torch.zeros_like(forward_ad.unpack_dual(value).primal)
    return forward_ad.make_dual(value, forward_ad.unpack_dual(slope).primal)


def constants_with_slopes(values: PlaceValues) -> PlaceValues:
    """The constants of a plant, each with a slope of zero unless it has one."""
    return Constants({place: {f: with_slope(v) for f, v in constants.items()} for place, constants in values.items()})


def directions(lanes: Float[Tensor, "L P"]) -> Float[Tensor, "PL P"]:
    """lanes (L, P) -> (P L, P): one copy of the batch per parameter, with the unit slope by that parameter."""
    count, parameters = lanes.shape
    along = torch.eye(parameters, dtype=lanes.dtype, device=lanes.device).repeat_interleave(count, dim=0)
    return with_slope(lanes.repeat(parameters, 1), along)


class ZeroSlopes(TorchFunctionMode):
    """A mode in which numbers in a tensor's arithmetic and newly created tensors have slopes of zero."""

    def __init__(self) -> None:
        super().__init__()
        self._numbers: dict[tuple[float, torch.dtype, torch.device], Tensor] = {}

    def __torch_function__(
        self,
        function: Callable[..., Any],
        types: Sequence[type],
        args: Sequence[Any] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        name = function.__name__
        if name in _ARITHMETIC:
            like = next((a for a in args if isinstance(a, Tensor) and a.is_floating_point()), None)
            if like is not None:
                args = [self._number(a, like) if isinstance(a, (int, float)) else a for a in args]
        result = function(*args, **(kwargs or {}))
        return with_slope(result) if name in _FACTORIES else result

    def _number(self, value: float, like: Tensor) -> Tensor:
        key = (float(value), like.dtype, like.device)
        if key not in self._numbers:
            self._numbers[key] = with_slope(torch.tensor(key[0], dtype=like.dtype, device=like.device))
        return self._numbers[key]
