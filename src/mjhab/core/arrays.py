"""The few array helpers the pure functions need; the same line runs on numpy and torch."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import lru_cache
from types import ModuleType
from typing import Any, TypeVar

import array_api_compat
import numpy as np

Array = Any
"""A numpy array or a torch tensor: whatever ``array_api_compat`` knows."""
# Scalars, too: reductions of numpy return them.
_NUMPY_TYPES = (np.ndarray, np.generic)

Record = TypeVar("Record")


def namespace(*arrays: Array) -> ModuleType:
    """Return the array-API namespace of the arrays: numpy itself, or what ``array_api_compat`` makes of torch.

    Raises:
        TypeError: the arrays come from different libraries, or are no arrays.
    """
    # numpy 2 follows the standard. array_api_compat's version of it loads numpy's tests and Fortran tools.
    for array in arrays:
        if not isinstance(array, _NUMPY_TYPES):
            return array_api_compat.array_namespace(*arrays)
    return np


def device_of(array: Array) -> Any:
    """Device of an array, as creation functions take it (asking array_api_compat costs 8 us per numpy array)."""
    return None if type(array) is np.ndarray else array_api_compat.device(array)


def to_numpy(array: Array) -> np.ndarray:
    """Return the array on the host as numpy (a view where the library allows one)."""
    if isinstance(array, np.ndarray):
        return array
    # By its method: torch is not imported where nobody uses it.
    if hasattr(array, "detach"):
        array = array.detach().cpu()
    return np.asarray(array)


def object_array(items: Sequence[Any]) -> np.ndarray:
    """(n,) array of n objects, whatever they are: lists of one length stay lists."""
    # ``np.array`` would make a table of lists of one length.
    return np.fromiter(items, object, len(items))


def as_like(values: Array, like: Array, dtype: Any = None) -> Array:
    """Return ``values`` as an array of the library, device and (unless given) dtype of ``like``."""
    xp = namespace(like)
    device = device_of(like)
    return xp.asarray(values, dtype=like.dtype if dtype is None else dtype, device=device)


# By identity, because comparing nested tuples for the lookup would cost more than making the array.
@dataclasses.dataclass(frozen=True, eq=False)
class Table:
    """Nested tuples of numbers that are known by identity: looking up the array made of them compares nothing."""

    values: tuple[Any, ...]


@lru_cache(maxsize=256)
def _constant(
    values: tuple[Any, ...] | Table, xp: ModuleType, device: Any, dtype: Any
) -> Array:
    return xp.asarray(
        values.values if isinstance(values, Table) else values, dtype=dtype, device=device
    )


def constant(values: tuple[Any, ...] | Table, like: Array) -> Array:
    """Return numbers as an array of the library, device and dtype of ``like``; never write into it.

    It is made once and kept, because on a GPU each creation is a transfer. Large tables are better wrapped in a
    ``Table``, short tuples come as they are.
    """
    return _constant(values, namespace(like), device_of(like), like.dtype)


@lru_cache(maxsize=256)
def _count(size: int, xp: ModuleType, device: Any) -> Array:
    """0, 1, ... size - 1; made once, as it is asked for several times a step. Never write into it."""
    return xp.arange(size, device=device)


def indices(values: tuple[Any, ...] | Table, like: Array) -> Array:
    """Return whole numbers as an int64 array on the device of ``like``, kept as by `constant`."""
    xp = namespace(like)
    return _constant(values, xp, device_of(like), xp.int64)


def zeros(shape: tuple[int, ...], like: Array) -> Array:
    """New zeros of the library, device and dtype of ``like``."""
    if type(like) is np.ndarray:
        return np.zeros(shape, like.dtype)
    return namespace(like).zeros(shape, dtype=like.dtype, device=device_of(like))


def empty(shape: tuple[int, ...], like: Array) -> Array:
    """A new array to be filled, of the library, device and dtype of ``like``."""
    if type(like) is np.ndarray:
        return np.empty(shape, like.dtype)
    return namespace(like).empty(shape, dtype=like.dtype, device=device_of(like))


def value_text(value: object) -> str:
    """What a value is, in words for messages: "float64 of shape (2, 3)" of an array, its type of anything else."""
    shape = getattr(value, "shape", None)
    if shape is None:
        return type(value).__name__
    return f"{getattr(value, 'dtype', type(value).__name__)} of shape {tuple(shape)}"


def between(x: Array, low: Array, high: Array) -> Array:
    """``x`` moved into [low, high]; all three are arrays, which broadcast."""
    if type(x) is np.ndarray:
        return np.clip(x, low, high)
    xp = namespace(x)
    return xp.minimum(xp.maximum(x, low), high)


def may_hold(mask: Array) -> bool:
    """Whether ``mask`` holds anywhere, as far as that is free to know: a device is not asked, because it would stall.

    For numpy only work that would be thrown away is skipped by it; elsewhere the answer is always True.
    """
    # Counting is several times faster than ``mask.any()``, and a control step asks some twenty times.
    return bool(np.count_nonzero(mask)) if type(mask) is np.ndarray else True


def pick_column(table: Array, index: Array) -> Array:
    """Return ``table[w, index[w]]`` for every world.

    Args:
        table: (W, S, ...) values.
        index: (W,) int64 within [0, S).
    """
    return table[count(index.shape[0], table), index]


def pile(rows: Sequence[Array]) -> Array:
    """Return K arrays (W,) of one dtype as one (K, W); cheaper than ``stack``, which reshapes every one of them."""
    if type(rows[0]) is np.ndarray:
        return np.array(rows)
    return namespace(rows[0]).concat(rows).reshape(len(rows), -1)


def cast(array: Array, dtype: Any) -> Array:
    """The array as ``dtype``; on numpy faster than the standard's ``astype``, which checks its arguments in Python."""
    if type(array) is np.ndarray:
        return array.astype(dtype)
    return namespace(array).astype(array, dtype)


def join_as(parts: Sequence[Array], dtype: Any) -> Array:
    """Return arrays (W, n) side by side, as ``dtype``; numpy converts while it copies."""
    if type(parts[0]) is np.ndarray:
        return np.concatenate(parts, axis=1, dtype=dtype)
    xp = namespace(parts[0])
    return xp.astype(xp.concat(parts, axis=1), dtype)


def count(size: int, like: Array) -> Array:
    """0, 1, ... size - 1 as int64 on the device of ``like``; never write into it."""
    return _count(size, namespace(like), device_of(like))


def where_rows(mask: Array, new: Record, old: Record) -> Record:
    """Return a record with the rows of ``new`` where ``mask`` holds and of ``old`` elsewhere.

    Args:
        mask: (W,) bool.
        new, old: dataclass instances of one type whose fields are arrays (W, ...) or both None.
    """
    chosen: dict[str, Any] = {}
    xp = namespace(mask)
    for field in dataclasses.fields(old):  # type: ignore[arg-type]
        a = getattr(new, field.name)
        b = getattr(old, field.name)
        if b is None:
            chosen[field.name] = a
            continue
        wide = (
            mask
            if b.ndim == 1
            else xp.reshape(mask, (mask.shape[0],) + (1,) * (b.ndim - 1))
        )
        chosen[field.name] = xp.where(wide, a, b)
    return type(old)(**chosen)


def row_of(record: Record, row: int) -> Record:
    """Return one row of a record of arrays (W, ...), copied to numpy."""
    # A view of the row would keep the arrays of all worlds alive.
    return map_record(lambda array: to_numpy(array[row]).copy(), record)


def with_row(record: Record, row: int, values: dict[str, Any]) -> Record:
    """Return a copy of a record of arrays (W, ...) in which row ``row`` has the values of that name."""
    chosen = {}
    for field in dataclasses.fields(record):  # type: ignore[arg-type]
        array = getattr(record, field.name)
        if array is not None:
            # Arrays that were returned before are not modified.
            array = namespace(array).asarray(array, copy=True)
            array[row] = as_like(values[field.name], array)
        chosen[field.name] = array
    return type(record)(**chosen)


def map_record(function: Any, record: Record) -> Record:
    """Return a copy of a dataclass of arrays with ``function`` applied to every field that is not None."""
    values = {f.name: getattr(record, f.name) for f in dataclasses.fields(record)}  # type: ignore[arg-type]
    return type(record)(
        **{k: None if v is None else function(v) for k, v in values.items()}
    )


def norm3(vector: Array) -> Array:
    """Euclidean length over a last axis of 3; written out so that every library rounds alike."""
    return namespace(vector).sqrt(dot3(vector, vector))


def dot3(a: Array, b: Array) -> Array:
    """Dot product over a last axis of 3."""
    product = a * b
    # Written out: reductions of numpy and torch sum in different orders.
    return product[..., 0] + product[..., 1] + product[..., 2]
