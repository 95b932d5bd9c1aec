"""Nested values as the flat texts of a metadata record."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import orjson

from fdi_torch.logbook.payload import plain


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Nested values as dotted names and texts: {"a": {"b": [1, 2]}} -> {"a.b": "[1,2]"}."""
    flat: dict[str, str] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            flat.update(flatten(value, f"{prefix}{name}."))
        else:
            flat[f"{prefix}{name}"] = value if isinstance(value, str) else _text(value)
    return flat


def _text(value: Any) -> str:
    try:
        return orjson.dumps(value).decode()
    except TypeError:
        return orjson.dumps(plain({"value": value}).get("value", str(value))).decode()
