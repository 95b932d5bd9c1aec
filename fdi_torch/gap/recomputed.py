"""Large results that are computed anew unless they were used recently.

A diagnosis compares dozens of fits. The derivatives of each take many times the memory of its trajectory, and are
rarely needed again after the fit was judged.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, Generic, TypeVar
from weakref import ReferenceType, ref

from torch import Tensor

KEPT = 1 << 27  # bytes of all results that are kept

T = TypeVar("T")


class Recomputed(Generic[T]):
    """A result that `compute` gives, the same at every call. value: if it is known already."""

    _recent: ClassVar[list[ReferenceType[Recomputed[Any]]]] = []

    def __init__(self, compute: Callable[[], T], value: T | None = None) -> None:
        self._compute, self._value, self._size = compute, value, 0
        if value is not None:
            self()

    def __call__(self) -> T:
        value = self._compute() if self._value is None else self._value
        if self._value is None or not self._size:
            self._value, self._size = value, _size(value, set())
        others = [other for each in self._recent if (other := each()) is not None and other is not self]
        total = self._size + sum(other._size for other in others)
        while others and total > KEPT:
            total -= others[0]._size
            others.pop(0)._value = None
        self._recent[:] = [ref(each) for each in (*others, self)]
        return value


def _size(value: Any, counted: set[int]) -> int:
    """Bytes of all tensors in an object of this package."""
    if isinstance(value, Tensor):
        storage = value.untyped_storage()
        size = 0 if storage.data_ptr() in counted else storage.nbytes()
        counted.add(storage.data_ptr())
        return size
    own = type(value).__module__.startswith(__name__.split(".")[0]) and id(value) not in counted
    counted.add(id(value))
    parts = value if isinstance(value, tuple) else vars(value).values() if own else ()
    return sum(_size(part, counted) for part in parts)
