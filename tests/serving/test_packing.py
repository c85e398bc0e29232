"""Messages come back as they were, and bytes that are no message are an error, never a crash and never code."""

from __future__ import annotations

import pickle
from contextlib import suppress
from typing import cast

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as some

from mjhab.serving.packing import ProtocolError, pack, unpack

NUMBERS = st.sampled_from(["|u1", "<i2", "<i8", "<f4", "<f8", "|b1"])


@given(some.arrays(NUMBERS, some.array_shapes(min_dims=0, max_dims=4, min_side=0)))
def test_arrays_come_back_bit_by_bit(array: np.ndarray) -> None:
    back = unpack(pack({"observation/image": array, "prompt": "pick up the bowl"}))
    assert back["prompt"] == "pick up the bowl"
    got = back["observation/image"]
    assert got.dtype == array.dtype and got.shape == array.shape
    assert got.tobytes() == array.tobytes()


def test_scalars_nested_maps_and_torch_tensors() -> None:
    value = {"a": [np.float32(0.5), {"b": np.bool_(True)}], "c": None}
    back = unpack(pack(value))
    assert back == value and back["a"][0].dtype == np.float32
    tensor = {
        b"__torch__": True,
        b"data": np.arange(3, dtype=np.float32).tobytes(),
        b"dtype": "torch.float32",
        b"shape": (3,),
    }
    assert unpack(as_bytes(tensor)).tolist() == [0.0, 1.0, 2.0]


@pytest.mark.parametrize(
    "array",
    [
        np.array([object()]),
        np.zeros(2, complex),
        np.zeros(2, "f4,i4"),
        np.array(["text"]),
    ],
    ids=["objects", "complex", "structure", "text"],
)
def test_arrays_without_numbers_are_refused(array: np.ndarray) -> None:
    with pytest.raises(ProtocolError, match="hold numbers"):
        pack({"x": array})


def as_bytes(value: object) -> bytes:
    return cast(bytes, msgpack.packb(value))


def array_map(**changes: object) -> bytes:
    """An array as it is packed, with changes."""
    entry = {b"__ndarray__": True, b"data": b"\0" * 8, b"dtype": "<f4", b"shape": (2,)}
    return as_bytes(entry | {key.encode(): value for key, value in changes.items()})


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (array_map(shape=(3,)), "has 8 bytes, not 12"),
        (array_map(shape=(-1,)), "has the shape"),
        (array_map(shape=(2**62, 2**62)), "has 8 bytes"),
        (array_map(shape=(True, 2)), "has the shape"),
        (array_map(shape=[1] * 20), "has the shape"),
        (array_map(dtype="|O"), "hold numbers"),
        (array_map(dtype="O8,O8"), "has the type|hold numbers"),
        (array_map(dtype="nonsense"), "has the type"),
        (array_map(dtype=7), "has the type"),
        (array_map(data="text"), "lacks its data"),
        (b"", "no msgpack message"),
        (b"\xc1", "no msgpack message"),
        (b"\x91" * 5000, "no msgpack message"),
        (b"\xdd\xff\xff\xff\xff", "no msgpack message"),
        (pickle.dumps({"actions": 1}), "no msgpack message"),
    ],
)
def test_what_is_no_message_is_an_error(data: bytes, message: str) -> None:
    with pytest.raises(ProtocolError, match=message):
        unpack(data)


@settings(max_examples=200)
@given(st.binary(max_size=200))
def test_any_bytes_give_a_value_or_an_error(data: bytes) -> None:
    with suppress(ProtocolError):
        unpack(data)
