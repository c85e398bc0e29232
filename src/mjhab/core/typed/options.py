"""Values checked against annotations: options that a caller gives in Python, and plain data of files.

msgspec 0.22 (`msgspec.convert`) was tried in its place: it refuses ``numpy.int64`` as a whole number and a path as a
text or a text as a path, takes NaN as a number, passes over unknown fields of dataclasses, and its messages ("Expected
`float`, got `str` - at `$.y[1]`") have neither the value nor the nearest name. It would need as much around it as this.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Callable, Collection, Mapping, Sequence
from numbers import Integral, Real
from os import PathLike, fspath
from pathlib import Path
from typing import Annotated, Any

from mjhab.core.errors import missing_field, unknown_name, wrong_type, wrong_value
from mjhab.core.typed.bounds import check_value
from mjhab.core.typed.flags import hints_of

MAX_TEXT_CHARACTERS = 10_000
"""Longest text; filters are the longest that are meant."""


def take_types(options: Any, apart: Collection[str] = (), owner: str = "") -> None:
    """Put defaults in place of None, and plain values in place of paths, lists and numbers of numpy, in a dataclass.

    Args:
        options: a frozen dataclass that is being made; it is changed in place.
        apart: fields that are checked elsewhere.
        owner: what the fields belong to, for messages: "task 'set_table'".

    Raises:
        FieldError: see `fitting`.
    """
    hints = typing.get_type_hints(type(options))
    for option in dataclasses.fields(options):
        if option.name in apart:
            continue
        value = getattr(options, option.name)
        if value is None:
            value = _default(option)
        # Some defaults are None themselves: something else determines them later.
        if value is not None or option.default is dataclasses.MISSING:
            value = fitting(option.name, hints[option.name], value, owner)
        # The dataclasses are frozen for everybody else.
        object.__setattr__(options, option.name, value)


def take_options(options: Any, apart: Collection[str] = ()) -> None:
    """`take_types`, and check what the marks of the fields say of numbers and outputs; see `check_value`.

    Args:
        options: a frozen dataclass that is being made; it is changed in place.
        apart: fields that are checked elsewhere.

    Raises:
        UsageError: a value is of another type or out of its bound, or an output cannot be written.
    """
    take_types(options, apart)
    for option in dataclasses.fields(options):
        if option.name not in apart:
            check_value(type(options), option.name, getattr(options, option.name))


def taken(owner: type[Any], name: str, value: Any, label: str = "") -> Any:
    """A value for a field of a dataclass, as the type of the field and within its bound.

    Args:
        owner: the dataclass.
        name: of the field.
        value: what the caller gave.
        label: how messages name it; "" for ``name``.

    Raises:
        UsageError: it is of another type, or the marks of the field forbid it.
    """
    hint = hints_of(owner)[name]
    if typing.get_origin(hint) is Annotated:
        hint = typing.get_args(hint)[0]
    value = fitting(label or name, hint, value)
    check_value(owner, name, value, label)
    return value


def _default(option: dataclasses.Field[Any]) -> Any:
    if option.default_factory is not dataclasses.MISSING:
        return option.default_factory()
    return None if option.default is dataclasses.MISSING else option.default


def fitting(name: str, hint: Any, value: Any, where: str = "") -> Any:
    """The value of an option, as the plain type that its annotation states.

    Args:
        name: of the option, for the message.
        hint: the annotation: text, path, whole number, number, yes or no, a tuple, list or mapping of these or of
            dataclasses, a function, a dataclass, one of some values, or several of these.
        value: what the caller gave; a path stands for its text, a list for a tuple, a number of numpy for a plain one.
        where: what the option belongs to, for the message.

    Raises:
        FieldError: it is of another type, or a text that is too long or holds NUL; the message names the entry.
    """
    return _ValueReader(where, plain=False).read(name, hint, value)


def with_tuples(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options that were JSON or msgpack, whose lists become the tuples that fields of configurations have."""
    return {
        str(name): tuple(value) if isinstance(value, list) else value
        for name, value in options.items()
    }


def read_record(kind: Any, value: Any, name: str, where: object = "") -> Any:
    """Plain data of a JSON file as ``kind``, see `fitting`; here an object stands for a dataclass with its fields.

    Args:
        kind: an annotation.
        value: data of JSON.
        name: of the value in the file, for the message: "home".
        where: the file, for the message.

    Raises:
        FieldError: the value does not fit, or a field is unknown or missing; the message names it: "home.floor.size".
    """
    return _ValueReader(str(where), plain=True).read(name, kind, value)


_UNFIT = object()
_WORDS: dict[Any, str] = {
    str: "a text",
    int: "a whole number",
    float: "a finite number",
    bool: "True or False",
    Path: "a path",
    tuple: "a tuple",
    list: "a list",
    dict: "an object with texts as keys",
    Mapping: "a mapping with texts as keys",
    Callable: "a function",
    types.NoneType: "None",
}


def _in_words(kind: Any) -> str:
    """A type in words, for messages: "a text" for str, "a LabelRule" for a dataclass of that name."""
    origin = typing.get_origin(kind) or kind
    entries = typing.get_args(kind)
    if origin is typing.Literal:
        return " or ".join(map(repr, entries))
    if origin is tuple and entries and Ellipsis not in entries:
        return f"a tuple of {len(entries)} entries"
    return _WORDS.get(origin) or f"a {getattr(kind, '__name__', kind)}"


@dataclasses.dataclass(frozen=True)
class _ValueReader:
    """Turns values into what annotations state.

    where: the file or object that the values are of, for messages.
    plain: whether they are data of JSON.
    """

    where: str
    plain: bool

    def read(self, name: str, hint: Any, value: Any) -> Any:
        is_union = typing.get_origin(hint) in (types.UnionType, typing.Union)
        kinds = typing.get_args(hint) if is_union else (hint,)
        for kind in kinds:
            found = self._as(name, kind, value)
            if found is not _UNFIT:
                return found
        expected = " or ".join(map(_in_words, kinds))
        raise wrong_type(name, value, expected, where=self.where)

    def _as(self, name: str, kind: Any, value: Any) -> Any:
        """The value as ``kind``, or `_UNFIT`."""
        origin = typing.get_origin(kind) or kind
        entries = typing.get_args(kind)
        # By name, too: numpy's is no bool of Python, and numpy need not be loaded.
        is_bool = isinstance(value, bool) or type(value).__name__ == "bool"
        if kind is Any or (origin is typing.Literal and value in entries):
            return value
        if origin is bool and is_bool:
            return bool(value)
        if origin is int and isinstance(value, Integral) and not is_bool:
            return int(value)
        if origin is float and isinstance(value, Real) and not is_bool:
            return _number(value)
        # Texts and paths stand for each other, as callers mix them.
        if origin in (str, Path) and isinstance(value, str | PathLike):
            return self._text(name, origin, fspath(value))
        if origin in (tuple, list) and isinstance(value, list | tuple):
            return self._sequence(name, kind, value)
        if origin in (dict, Mapping) and isinstance(value, Mapping):
            return self._mapping(name, entries, value)
        if origin is Callable and callable(value):
            return value
        if self.plain and dataclasses.is_dataclass(origin) and isinstance(value, dict):
            return self._fields(name, origin, value)
        is_object = isinstance(origin, type) and origin not in _WORDS
        fits = (is_object or origin is types.NoneType) and isinstance(
            value, typing.cast(type, origin)
        )
        return value if fits else _UNFIT

    def _text(self, name: str, kind: Callable[[str], Any], value: Any) -> Any:
        # A path may be made of bytes.
        if not isinstance(value, str):
            return _UNFIT
        # The system ends a name at NUL, and would open another file.
        if len(value) > MAX_TEXT_CHARACTERS or "\0" in value:
            expected = f"a text of at most {MAX_TEXT_CHARACTERS:,} characters without NUL"
            raise wrong_value(name, value, expected, where=self.where)
        return kind(value)

    def _sequence(self, name: str, kind: Any, value: Sequence[Any]) -> Any:
        origin = typing.get_origin(kind) or kind
        kinds = typing.get_args(kind) or (Any, ...)
        if origin is list or Ellipsis in kinds:
            kinds = (kinds[0],) * len(value)
        if len(kinds) != len(value):
            return _UNFIT
        pairs = enumerate(zip(kinds, value, strict=True))
        return origin(
            self.read(f"{name}[{i}]", kind, entry) for i, (kind, entry) in pairs
        )

    def _mapping(
        self, name: str, entries: tuple[Any, ...], value: Mapping[Any, Any]
    ) -> Any:
        if not all(isinstance(key, str) for key in value):
            return _UNFIT
        # Mappings of Python may be read-only or a user's own: only those of files are made anew.
        if not self.plain or not entries:
            return value
        return {
            key: self.read(f"{name}[{key!r}]", entries[1], entry)
            for key, entry in value.items()
        }

    def _fields(self, name: str, kind: Any, value: Mapping[str, Any]) -> Any:
        hints = typing.get_type_hints(kind)
        known = {field.name: field for field in dataclasses.fields(kind) if field.init}
        # Unknown fields are told and not passed over: a misspelt one would silently have no effect.
        for key in sorted(set(value) - set(known)):
            raise unknown_name("field", key, known, where=self._place(name))
        lacking = [
            key for key, field in known.items() if key not in value and _is_needed(field)
        ]
        if lacking:
            raise missing_field(lacking[0], self._place(name))
        return kind(
            **{
                key: self.read(f"{name}.{key}", hints[key], entry)
                for key, entry in value.items()
            }
        )

    def _place(self, name: str) -> str:
        return f"{self.where}: {name}" if self.where else name


def _is_needed(field: dataclasses.Field[Any]) -> bool:
    return (
        field.default is dataclasses.MISSING
        and field.default_factory is dataclasses.MISSING
    )


def _number(value: Real) -> Any:
    try:
        number = float(value)
    except OverflowError:  # a whole number of hundreds of digits
        return _UNFIT
    # JSON of Python holds NaN and infinity, which no field means.
    return number if math.isfinite(number) else _UNFIT
