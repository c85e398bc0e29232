"""The options of all commands, and values that none of them can work with."""

from __future__ import annotations

import dataclasses
import math
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mjhab.cli import commands
from mjhab.cli.parsing import Option, Parsed, options_of
from mjhab.core.typed.bounds import Bound
from mjhab.core.typed.flags import OptionsOf, flag_of, hints_of, mark_of

BAD: dict[type, tuple[Any, ...]] = {
    int: (-(2**70), -2, 2**64),
    float: (-1.0, math.nan, math.inf, 1e300),
    str: ("x" * 20_000, "a\0b"),
    Path: (Path("x" * 20_000), Path("a\0b")),
}
OUTPUTS = ("out", "page", "export", "log", "record")
BAD_OUTPUTS = (
    Path("/proc/mjhab/x"),
    Path("/dev/null"),
    Path("/dev/null/x"),
    Path("x" * 300),
)
SPECS = commands.COMMANDS


def bad_values(command: commands.Command) -> Iterator[tuple[Option, Any]]:
    """Options of a command with values out of all range, by type."""
    for option in options_of(command.spec_type):
        kinds = set(_plain(option.hint))
        many = typing.get_origin(option.hint) is tuple
        for kind, values in BAD.items():
            if kind in kinds and option.keyed is None:
                yield from ((option, (value,) if many else value) for value in values)
        if option.name in OUTPUTS:
            yield from ((option, value) for value in BAD_OUTPUTS)


def made(command: commands.Command, option: Option | None = None, value: Any = None):
    """The specification of a command line with what must be given, and with ``value`` for an option."""
    values: dict[str, Any] = {}
    for other in options_of(command.spec_type):
        if other.default is dataclasses.MISSING and not other.optional:
            _put(values, other, _any(other))
    if option is not None:
        _put(values, option, value)
    spec = Parsed(command, values).spec
    # Options of environments are checked when the environment is asked for.
    return getattr(spec, "asked", spec)


def fields_of(command: commands.Command) -> Iterator[tuple[type, str, Any]]:
    """Dataclasses that hold a command's options, the names of their fields, and the defaults that these have there."""
    yield from _fields_of(command.spec_type, {})


def _fields_of(
    owner: type, defaults: Mapping[str, Any]
) -> Iterator[tuple[type, str, Any]]:
    for field in dataclasses.fields(owner):
        hint = hints_of(owner)[field.name]
        many = mark_of(owner, field.name, OptionsOf)
        marked = typing.get_origin(hint) is typing.Annotated
        inner = typing.get_args(hint)[0] if marked else hint
        kind = flag_of(owner, field.name).kind
        if many is not None:
            yield from _fields_of(many.owner, many.defaults)
        for part in (inner, kind):
            if isinstance(part, type) and dataclasses.is_dataclass(part):
                yield from _fields_of(part, {})
        yield owner, field.name, defaults.get(field.name, field.default)


def bounds_in(owner: type, name: str) -> list[Bound]:
    """The bounds at any depth of the annotation of a field."""
    return list(_bounds_of(hints_of(owner)[name]))


def _bounds_of(hint: Any) -> Iterator[Bound]:
    yield from (
        mark for mark in getattr(hint, "__metadata__", ()) if isinstance(mark, Bound)
    )
    for part in typing.get_args(hint):
        yield from _bounds_of(part)


def _put(values: dict[str, Any], option: Option, value: Any) -> None:
    *parts, last = option.path
    for part in parts:
        values = values.setdefault(part, {})
    values[last] = value


def _any(option: Option) -> Any:
    path = Path("new.json" if "json" in option.flag.metavar else "new.h5")
    if "html" in option.flag.metavar:
        path = Path("new.html")
    if "ms_hab" in option.flag.metavar:
        return "ms_hab"
    kinds = set(_plain(option.hint))
    one = path if Path in kinds else "expert"
    return (one,) if typing.get_origin(option.hint) is tuple else one


def _plain(hint: Any) -> Iterator[type]:
    """The types in a hint, e.g. int of ``tuple[int, ...] | None``."""
    parts = typing.get_args(hint)
    if not parts:
        yield hint
    for part in parts:
        yield from _plain(part)
