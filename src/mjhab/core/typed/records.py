"""Plain data of files as frozen dataclasses, each field checked against its annotation."""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from typing import Any

from mjhab.core.errors import shown


def read_record(kind: Any, value: Any, where: str) -> Any:
    """Turn plain data of JSON into ``kind``: dataclasses, tuples, lists, dictionaries, literals, numbers, strings,
    booleans.

    Raises:
        ValueError: the value does not fit; the message names the field.
    """
    if kind is Any:
        return value
    origin = typing.get_origin(kind)
    args = typing.get_args(kind)
    if dataclasses.is_dataclass(kind):
        return _read_fields(kind, value, where)
    if origin is types.UnionType:
        return None if value is None else read_record(args[0], value, where)
    if origin is list:
        return list(read_record(tuple[args[0], ...], value, where))
    if origin is tuple:
        if not isinstance(value, list | tuple) or (
            Ellipsis not in args and len(value) != len(args)
        ):
            raise ValueError(
                f"{where}: expected a list of {'any' if Ellipsis in args else len(args)} entries."
            )
        kinds = [args[0]] * len(value) if Ellipsis in args else list(args)
        return tuple(
            read_record(k, v, f"{where}[{i}]")
            for i, (k, v) in enumerate(zip(kinds, value, strict=True))
        )
    if origin is dict:
        if not isinstance(value, dict):
            raise ValueError(f"{where}: expected an object.")
        return {
            key: read_record(args[1], entry, f"{where}[{key!r}]")
            for key, entry in value.items()
        }
    if origin is typing.Literal:
        if value not in args:
            raise ValueError(
                f"{where}: {shown(value)} is not one of {', '.join(map(str, args))}."
            )
        return value
    if kind is float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(f"{where}: expected a number, got {shown(value)}.")
        number = _float(value)
        if not math.isfinite(number):
            raise ValueError(f"{where}: expected a finite number, got {number}.")
        return number
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise ValueError(f"{where}: expected {kind.__name__}, got {shown(value)}.")
    return value


def _float(value: int | float) -> float:
    try:
        return float(value)
    except OverflowError:  # an integer of hundreds of digits
        return math.inf


def _read_fields(kind: Any, value: Any, where: str) -> Any:
    if not isinstance(value, dict):
        raise ValueError(
            f"{where}: expected an object with the fields of {kind.__name__}."
        )
    hints = typing.get_type_hints(kind)
    fields = {f.name: f for f in dataclasses.fields(kind)}
    unknown = sorted(set(value) - set(fields))
    if unknown:
        raise ValueError(
            f"{where}: unknown field {unknown[0]!r}; fields are {', '.join(fields)}."
        )
    read = {}
    for name, f in fields.items():
        if name in value:
            read[name] = read_record(hints[name], value[name], f"{where}.{name}")
        elif (
            f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING
        ):
            raise ValueError(f"{where}: field {name!r} is missing.")
    return kind(**read)
