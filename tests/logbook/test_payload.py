"""Lossless conversion of messages to JSON and back."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
import orjson
import pytest
import torch

from fdi_torch.logbook.payload import decode, pack, plain, unpack


def encode(fields: Mapping[str, Any]) -> bytes:
    return orjson.dumps(plain(fields))


def bits(value: float) -> bytes:
    return struct.pack("<d", value)


def test_every_finite_number_survives_bit_for_bit() -> None:
    rng = np.random.default_rng(1)
    patterns = rng.integers(0, 2**64, 2000, dtype=np.uint64).view(np.float64)
    numbers = [*patterns[np.isfinite(patterns)].tolist(), 0.0, -0.0, 5e-324, 1.7976931348623157e308]
    back = decode(encode({"values": numbers, "one": -0.0}))
    assert [bits(x) for x in back["values"]] == [bits(x) for x in numbers]
    assert bits(back["one"]) == bits(-0.0)


def test_numbers_json_cannot_hold_come_back() -> None:
    message = {"h1": math.nan, "h2": math.inf, "values": [1.0, -math.inf, math.nan], "x": 2.0}
    data = encode(message)
    assert orjson.loads(data)["values"] == [1.0, 0.0, 0.0]
    assert b"null" not in data
    back = decode(data)
    assert math.isnan(back["h1"]) and back["h2"] == math.inf and back["x"] == 2.0
    assert back["values"][1] == -math.inf and math.isnan(back["values"][2])
    assert "non_finite" not in back


def test_float32_is_widened_not_rounded() -> None:
    third = torch.tensor(1 / 3, dtype=torch.float32)
    assert decode(encode({"x": third}))["x"] == third.double().item()
    assert decode(encode({"x": np.float32(1 / 3)}))["x"] == float(np.float32(1 / 3))


def test_tensors_that_need_gradients_and_flags_and_counts() -> None:
    value = torch.tensor([[1.0, 2.0], [3.0, 4.0]], requires_grad=True)
    back = decode(encode({"m": value, "flag": True, "n": np.int64(3), "names": ("a", "b"), "none": None}))
    assert back == {"m": [1.0, 2.0, 3.0, 4.0], "flag": True, "n": 3, "names": ["a", "b"]}


def test_integers_that_readers_would_round_are_refused() -> None:
    with pytest.raises(ValueError, match=r"seed: expected an integer of at most 2\^53, got 9007199254740993"):
        encode({"seed": 2**53 + 1})


def test_what_is_no_number_is_refused() -> None:
    with pytest.raises(ValueError, match="x: expected numbers or text, got object"):
        encode({"x": object()})
    with pytest.raises(ValueError, match="x: expected an array of numbers"):
        pack("x", np.array(["a"]))
    with pytest.raises(ValueError, match="expected a JSON object"):
        decode(b"[1]")


@pytest.mark.parametrize("dtype", ["f8", "f4", "i4", "u1", "?"])
def test_packed_arrays_keep_shape_and_bits(dtype: str) -> None:
    array = np.arange(6).reshape(2, 3).astype(dtype)
    back = unpack(decode(encode(pack("population", array))))["population"]
    assert back.shape == (2, 3)
    np.testing.assert_array_equal(back, array)


def test_packed_arrays_hold_nan_and_random_state() -> None:
    state = torch.Generator().manual_seed(3).get_state()
    fields = {**pack("cost", np.array([np.nan, 1.0])), **pack("state", state)}
    back = unpack(decode(encode(fields)))
    assert np.isnan(back["cost"][0])
    torch.testing.assert_close(torch.from_numpy(back["state"].copy()), state)


def test_a_packed_array_of_another_type_is_refused() -> None:
    with pytest.raises(ValueError, match="expected one of the types"):
        unpack({"x": "", "x_shape": [0], "x_dtype": "O"})


def test_a_hostile_list_of_lost_numbers_changes_nothing_else() -> None:
    back = decode(b'{"a":[1],"non_finite":["a[99]=nan","a","b[0]=inf",3]}')
    assert back == {"a": [1]}
    no_lists = {"a": 1, "b": "x", "c": None, "d": {}}
    assert decode(orjson.dumps({**no_lists, "non_finite": [f"{name}[0]=nan" for name in no_lists]})) == no_lists
