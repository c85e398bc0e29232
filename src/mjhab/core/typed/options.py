"""Types of options that a caller gives in Python, where no parser has looked at them."""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Callable, Collection, Mapping
from numbers import Integral, Real
from os import PathLike, fspath
from pathlib import Path
from typing import Any

from mjhab.core.errors import UsageError, shown

MAX_TEXT_CHARACTERS = 4096


def take_types(options: Any, apart: Collection[str] = (), owner: str = "") -> None:
    """Put defaults in place of None, and plain values in place of paths, lists and numbers of numpy, in a dataclass.

    Args:
        options: a frozen dataclass that is being made; it is changed in place.
        apart: fields that are checked elsewhere.
        owner: what the fields belong to, for messages: "task 'set_table'".

    Raises:
        UsageError: see `fitting`.
    """
    hints = typing.get_type_hints(type(options))
    prefix = f"{owner}: " if owner else ""
    for option in dataclasses.fields(options):
        if option.name in apart:
            continue
        value = getattr(options, option.name)
        if value is None:
            value = _default(option)
        # Some defaults are None themselves: something else determines them later.
        if value is not None or option.default is dataclasses.MISSING:
            value = fitting(f"{prefix}{option.name}", hints[option.name], value)
        object.__setattr__(options, option.name, value)


def _default(option: dataclasses.Field[Any]) -> Any:
    if option.default_factory is not dataclasses.MISSING:
        return option.default_factory()
    return None if option.default is dataclasses.MISSING else option.default


def fitting(name: str, hint: Any, value: Any) -> Any:
    """The value of an option, as the plain type that its annotation states.

    Args:
        name: of the option, for the message.
        hint: the annotation: text, whole number, number, yes or no, a tuple of these or of dataclasses, a mapping with
            texts as keys, a function, a dataclass, one of some values, or several of these.
        value: what the caller gave; a path stands for its text, a list for a tuple, a number of numpy for a plain one.

    Raises:
        UsageError: it is of another type, or a text that is too long or holds NUL.
    """
    kinds = typing.get_args(hint) if _is_union(hint) else (hint,)
    for kind in kinds:
        found = _read(name, kind, value)
        if found is not _UNFIT:
            return found
    expected = " or ".join(map(_in_words, kinds))
    raise UsageError(
        f"{name} must be {expected}, got {shown(value)} ({type(value).__name__})."
    )


_UNFIT = object()
_WORDS: dict[Any, str] = {
    str: "a text",
    int: "a whole number",
    float: "a finite number",
    bool: "True or False",
    Path: "a path",
    tuple: "a tuple",
    Mapping: "a mapping with texts as keys",
    Callable: "a function",
    types.NoneType: "None",
}


def _in_words(kind: Any) -> str:
    """A type in words, for messages: "a text" for str, "a LabelRule" for a dataclass of that name."""
    origin = typing.get_origin(kind) or kind
    if origin is typing.Literal:
        return " or ".join(map(repr, typing.get_args(kind)))
    is_record = isinstance(kind, type) and dataclasses.is_dataclass(kind)
    return _WORDS.get(origin, f"a {kind.__name__}" if is_record else str(kind))


def _is_union(hint: Any) -> bool:
    return typing.get_origin(hint) in (types.UnionType, typing.Union)


def _read(name: str, kind: Any, value: Any) -> Any:
    """The value as ``kind``, or `_UNFIT`."""
    origin = typing.get_origin(kind) or kind
    is_bool = isinstance(value, bool) or type(value).__name__ == "bool"
    if origin is types.NoneType:
        return None if value is None else _UNFIT
    if origin is bool:
        return bool(value) if is_bool else _UNFIT
    if origin is str and isinstance(value, str | PathLike):
        return _text(name, fspath(value))
    if origin is Path and isinstance(value, str | PathLike):
        text = _text(name, fspath(value))
        return _UNFIT if text is _UNFIT else Path(text)
    if origin is int and isinstance(value, Integral) and not is_bool:
        return int(value)
    if origin is float and isinstance(value, Real) and not is_bool:
        return _number(value)
    if origin is tuple and isinstance(value, list | tuple):
        return _tuple(name, typing.get_args(kind), value)
    if origin is typing.Literal:
        return value if value in typing.get_args(kind) else _UNFIT
    if origin is Callable and callable(value):
        return value
    if origin is Mapping and isinstance(value, Mapping):
        return value if all(isinstance(key, str) for key in value) else _UNFIT
    if dataclasses.is_dataclass(origin) and isinstance(value, typing.cast(type, origin)):
        return value
    return _UNFIT


def _number(value: Real) -> Any:
    try:
        number = float(value)
    except OverflowError:
        return _UNFIT
    return number if math.isfinite(number) else _UNFIT


def _tuple(name: str, kinds: tuple[Any, ...], value: list[Any] | tuple[Any, ...]) -> Any:
    if Ellipsis in kinds:
        kinds = (kinds[0],) * len(value)
    if len(kinds) != len(value):
        return _UNFIT
    found = tuple(
        _read(name, kind, entry) for kind, entry in zip(kinds, value, strict=True)
    )
    return _UNFIT if any(entry is _UNFIT for entry in found) else found


def _text(name: str, value: Any) -> Any:
    if not isinstance(value, str):
        return _UNFIT
    if len(value) > MAX_TEXT_CHARACTERS or "\0" in value:
        raise UsageError(
            f"{name} must be a text of at most {MAX_TEXT_CHARACTERS:,} characters without NUL, got {shown(value)}."
        )
    return value
