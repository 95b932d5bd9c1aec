"""The type checker of shapes in signatures, as jaxtyping's import hook takes it; see `test_shapes.py`."""

from __future__ import annotations

from typing import Any

from beartype import beartype


def checked(function: Any) -> Any:
    """The function with a check of those annotations that state a shape; mypy checks the others."""
    function.__annotations__ = {
        name: hint for name, hint in function.__annotations__.items() if "Tensor, " in str(hint)
    }
    return beartype(function)
