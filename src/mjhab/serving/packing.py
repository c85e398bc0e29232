"""Messages as bytes: msgpack with numpy arrays, packed as by openpi (packages/openpi-client, msgpack_numpy.py).

An array is a map ``{b"__ndarray__": True, b"data": bytes, b"dtype": str, b"shape": tuple}``, a numpy scalar is
``{b"__npgeneric__": True, b"data": value, b"dtype": str}``. BEHAVIOR packs torch tensors like arrays, under the key
``b"__torch__"``. Arrays hold numbers only: objects, structures and texts are refused in both directions.
"""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np

from mjhab.core.errors import MjhabError

_NUMBER_KINDS = "biuf"
_MOST_DIMENSIONS = 8
_TORCH = "torch."


class ProtocolError(MjhabError):
    """A message is not what the dialect says."""


def pack(value: Any) -> bytes:
    """A message as bytes.

    Raises:
        ProtocolError: it holds something that is neither plain data nor an array of numbers.
    """
    import msgpack

    try:
        return cast(bytes, msgpack.packb(value, default=_plain))
    except (TypeError, ValueError, OverflowError) as error:
        raise ProtocolError(f"the message cannot be packed: {error}") from error


def unpack(data: bytes) -> Any:
    """A message of bytes. Arrays are views of ``data`` and cannot be written to.

    Raises:
        ProtocolError: the bytes are no message, or an array in it does not fit its bytes.
    """
    import msgpack

    try:
        return msgpack.unpackb(data, object_hook=_restore, strict_map_key=True)
    except ProtocolError:
        raise
    # msgpack raises several kinds for bytes that are none of its own, RecursionError-like ones among them.
    except Exception as error:
        shown = bytes(data[:24])
        raise ProtocolError(
            f"{len(data)} bytes beginning with {shown!r} are no msgpack message ({type(error).__name__}: {error})"
        ) from error


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        _check_kind(value.dtype)
        return {
            b"__ndarray__": True,
            b"data": value.tobytes(),
            b"dtype": value.dtype.str,
            b"shape": value.shape,
        }
    if isinstance(value, np.generic):
        _check_kind(value.dtype)
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    raise TypeError(f"{type(value).__name__} is no plain data")


def _restore(value: dict[Any, Any]) -> Any:
    """What a map stands for: an array, a number, or the map itself."""
    for key in (b"__ndarray__", b"__torch__"):
        if key in value:
            return _array(value)
    if b"__npgeneric__" in value:
        return _dtype(value).type(value.get(b"data"))
    return value


def _array(value: dict[Any, Any]) -> np.ndarray:
    data = value.get(b"data")
    shape = value.get(b"shape")
    if not isinstance(data, bytes) or not isinstance(shape, list | tuple):
        raise ProtocolError("an array in the message lacks its data or its shape")
    whole = all(isinstance(n, int) and not isinstance(n, bool) and n >= 0 for n in shape)
    if not whole or len(shape) > _MOST_DIMENSIONS:
        raise ProtocolError(f"an array in the message has the shape {shape!r}")
    dtype = _dtype(value)
    needed = math.prod(shape) * dtype.itemsize
    # A view over fewer bytes would fail later, and over more read what belongs to another array.
    if needed != len(data):
        raise ProtocolError(
            f"an array {tuple(shape)} of {dtype} in the message has {len(data)} bytes, not {needed}"
        )
    return np.frombuffer(data, dtype).reshape(shape)


def _dtype(value: dict[Any, Any]) -> np.dtype:
    name = value.get(b"dtype")
    text = name.decode("ascii", "replace") if isinstance(name, bytes) else name
    if not isinstance(text, str):
        raise ProtocolError(f"an array in the message has the type {name!r}")
    try:
        dtype = np.dtype(text.removeprefix(_TORCH))
    except (TypeError, ValueError, SyntaxError) as error:
        raise ProtocolError(f"an array in the message has the type {text!r}") from error
    _check_kind(dtype)
    return dtype


def _check_kind(dtype: np.dtype) -> None:
    # Objects would be pickles, which run code when they are read.
    if dtype.kind not in _NUMBER_KINDS:
        raise ProtocolError(f"arrays in messages hold numbers, not {dtype}")
