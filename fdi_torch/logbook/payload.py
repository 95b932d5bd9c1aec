"""Lossless conversion between a message and JSON.

JSON has no NaN and no infinity. A non-finite scalar is omitted from its message, a non-finite element of an array is
replaced by 0; both are listed in the string array `non_finite` as `name=nan`, `name=inf`, `name[3]=-inf`, from which
`decode` restores them. Finite float64 are preserved exactly; float32 is widened first. Integers beyond 2^53, which many
readers round, are rejected. Arrays with a shape are base64 of little-endian bytes (`pack`, `unpack`).
"""

from __future__ import annotations

import base64
import binascii
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import orjson

NON_FINITE = "non_finite"
WALL = "wall"
_EXACT = 2**53
_ENTRY = re.compile(r"(?P<name>.+?)(\[(?P<index>\d+)\])?=(?P<value>nan|inf|-inf)")
_PLAIN = frozenset({type(None), str, bool, float})
_AS_IT_IS = frozenset({str, bool, int, float})
_PACKED = {"f": "<f8", "i": "<i8", "u": "<i8", "b": "|b1"}
_DTYPES = ("<f8", "<i8", "|u1", "|b1")


def as_it_is(message: Mapping[str, Any]) -> bytes | None:
    """Fast path for plain numbers, texts and homogeneous flat lists; None for other messages.

    The bytes are those of orjson.dumps(plain(message)). A message with a non-finite number, which JSON would show as
    null, also gets None.
    """
    kinds = set(map(type, message.values()))
    if list in kinds:
        for value in message.values():
            if type(value) is list:
                inside = set(map(type, value))
                kinds |= inside if len(inside) < 2 else {object}  # mixed integers and floats need conversion
        kinds.discard(list)
    if not kinds <= _AS_IT_IS:
        return None
    try:
        data = orjson.dumps(message, option=orjson.OPT_STRICT_INTEGER)
    except TypeError:  # an integer that is too large; `plain` reports it
        return None
    return None if b"null" in data else data


def plain(fields: Mapping[str, Any]) -> dict[str, Any]:
    """The fields as JSON values, with non-finite numbers moved to the field `non_finite`."""
    message: dict[str, Any] = {}
    non_finite: list[str] = []
    for name, value in fields.items():
        value = _plain_value(name, value)
        if type(value) is float and not math.isfinite(value):
            non_finite.append(f"{name}={value}")
        elif value is not None:
            message[name] = _finite_list(name, value, non_finite) if type(value) is list else value
    if non_finite:
        message[NON_FINITE] = non_finite
    return message


def decode(data: bytes) -> dict[str, Any]:
    """The fields of a JSON message with non-finite numbers restored. Raises ValueError if it is not a JSON object."""
    message = orjson.loads(data)
    if not isinstance(message, dict):
        raise ValueError(f"expected a JSON object as message, got {type(message).__name__}")
    if b'"non_finite"' in data:
        _restore(message)
    return message


def pack(name: str, array: Any) -> dict[str, Any]:
    """An array of any shape as three flat fields: `name` (base64), `name_shape`, `name_dtype`."""
    values = as_array(array)
    kind = _PACKED.get(values.dtype.kind)
    if kind is None:
        raise ValueError(f"{name}: expected an array of numbers, got {values.dtype}; convert it")
    kind = "|u1" if values.dtype == np.uint8 else kind
    text = binascii.b2a_base64(values.astype(kind, copy=False).tobytes(), newline=False).decode()
    return {name: text, f"{name}_shape": list(values.shape), f"{name}_dtype": kind}


def unpack(message: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Every array that `pack` put into a message, by name."""
    names = [key[: -len("_shape")] for key in message if key.endswith("_shape")]
    return {name: _unpack_one(name, message) for name in names if f"{name}_dtype" in message}


def as_array(value: Any) -> np.ndarray:
    """A numpy array from a number, list, array or tensor on any device."""
    if not hasattr(value, "detach"):
        return np.asarray(value)
    try:
        return np.asarray(value.numpy())  # four times faster than the general case below
    except (RuntimeError, TypeError):
        return np.asarray(value.numpy(force=True))


def _unpack_one(name: str, message: Mapping[str, Any]) -> np.ndarray:
    dtype = message[f"{name}_dtype"]
    if dtype not in _DTYPES:
        raise ValueError(f"{name}: expected one of the types {', '.join(_DTYPES)}, got {dtype}")
    values = np.frombuffer(base64.b64decode(message[name], validate=True), dtype=dtype)
    return values.reshape(message[f"{name}_shape"])


def _plain_value(name: str, value: Any) -> Any:
    if type(value) in _PLAIN:
        return value
    if isinstance(value, str | bool | float):
        return float(value) if isinstance(value, np.floating) else value
    if isinstance(value, int | np.integer):
        return _exact_integer(name, int(value))
    if isinstance(value, Mapping):
        return plain(value)
    if isinstance(value, Sequence) and all(isinstance(item, str) for item in value):
        return list(value)
    if type(value) is list and all(type(item) is int for item in value):
        return [_exact_integer(name, item) for item in value]
    array = as_array(value)
    if array.dtype.kind not in "fiub":
        raise ValueError(f"{name}: expected numbers or text, got {type(value).__name__}; convert it")
    if array.dtype.kind == "f":
        array = array.astype(np.float64)
    return array.item() if array.ndim == 0 else array.ravel().tolist()


def _exact_integer(name: str, value: int) -> int:
    if abs(value) > _EXACT:
        raise ValueError(f"{name}: expected an integer of at most 2^53, got {value}; write it as text")
    return value


def _finite_list(name: str, values: list[Any], non_finite: list[str]) -> list[Any]:
    positions = [i for i, value in enumerate(values) if isinstance(value, float) and not math.isfinite(value)]
    for i in positions:
        non_finite.append(f"{name}[{i}]={values[i]}")
        values[i] = 0.0
    return values


def _restore(message: dict[str, Any]) -> None:
    entries = message.pop(NON_FINITE, ())
    for entry in entries if isinstance(entries, list) else ():
        match = _ENTRY.fullmatch(str(entry))
        values = message.get(match["name"]) if match else None
        if match and match["index"] is None:
            message[match["name"]] = float(match["value"])
        elif match and isinstance(values, list) and int(match["index"]) < len(values):
            values[int(match["index"])] = float(match["value"])
