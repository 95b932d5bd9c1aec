"""The device of torch on which a job computes."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import wraps
from typing import ParamSpec, TypeVar

import torch

P = ParamSpec("P")
T = TypeVar("T")


def usable_device(name: str) -> torch.device:
    """The device of that name. Raises ValueError if it is not available."""
    try:
        torch.zeros(1, device=name)
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"device: expected one that torch can use here, got '{name}'; write device: cpu") from error
    return torch.device(name)


def tensors_on(device: torch.device) -> AbstractContextManager[object]:
    """Context that creates tensors on a device; empty for the default device, because torch's context
    slows each call.
    """
    return nullcontext() if device == torch.get_default_device() else device


def on_its_device(function: Callable[P, T]) -> Callable[P, T]:
    """Create the tensors of a function on the device of its first argument, its `device`."""

    @wraps(function)
    def there(*arguments: P.args, **named: P.kwargs) -> T:
        with tensors_on(arguments[0].device):  # type: ignore[attr-defined]
            return function(*arguments, **named)

    return there
