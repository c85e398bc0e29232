"""Command lines from specifications: every field of a dataclass, of dataclasses in it and of `OptionsOf` is an option.

tyro parses a flat dataclass that is made of the specification; `Parsed` holds the specification made of its values.
"""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import tyro

from mjhab.cli.commands import Command, load
from mjhab.cli.options.limits import check_limits
from mjhab.core.typed.flags import Flag, OptionsOf, field_docs, summary_of

TYRO = (
    tyro.conf.OmitSubcommandPrefixes,
    tyro.conf.OmitArgPrefixes,
    tyro.conf.FlagCreatePairsOff,
)
"""Configuration of tyro for all commands."""
METAVARS: Mapping[Any, str] = {
    int: "N",
    float: "NUMBER",
    str: "NAME",
    Path: "PATH",
    bool: "True|False",
}


@dataclass(frozen=True)
class Option:
    """An option of a command.

    name: without dashes, with underscores. path: of the field in the specification; keys of mappings, too.
    hint: type. default: dataclasses.MISSING for an option that must be given; None of an option that may be absent and
    then is not part of the specification, see ``optional``. flag: what the annotation says. help: the docstring.
    """

    name: str
    path: tuple[str, ...]
    hint: Any
    default: Any
    flag: Flag
    help: str
    optional: bool = False

    @property
    def is_switch(self) -> bool:
        """Whether it takes no value: without it something is off."""
        return self.hint is bool and self.default is False

    @property
    def takes_value(self) -> bool:
        """Whether a value follows its name; none does after --no-NAME, the option of what is on without it."""
        return self.hint is not bool or (self.optional and not self.is_switch)

    def is_absent(self, value: Any) -> bool:
        """Whether a parsed value means that the option was not given."""
        return self.optional and (value is False if self.is_switch else value is None)

    @property
    def default_text(self) -> str:
        """The default in words, for pages; "must be given" if there is none."""
        if self.flag.shown:
            return self.flag.shown.removeprefix("default: ")
        if self.default is dataclasses.MISSING:
            return "must be given"
        if not self.takes_value:
            return "off"
        return _in_words(self.default)

    def as_field(self) -> tuple[str, Any, Any]:
        """Name, annotation and default for `dataclasses.make_dataclass`."""
        hint = self.hint
        default = self.default
        shown = self.flag.shown or ("default: none" if default in ((), "") else "")
        if self.flag.positional and default is dataclasses.MISSING:
            shown = "required"
        if self.optional and not self.is_switch:
            hint = hint | None
            shown = shown or f"default: {_in_words(default)}"
            default = None
        told = tyro.conf.arg(
            metavar=(self.flag.metavar or _metavar(hint)) if self.takes_value else None,
            help=self.help,
            help_behavior_hint=f"({shown})" if shown else None,
        )
        annotation = Annotated[hint, told]
        if self.flag.positional:
            annotation = tyro.conf.Positional[annotation]
        if default is dataclasses.MISSING:
            return (self.name, annotation, dataclasses.field())
        return (self.name, annotation, dataclasses.field(default=default))


@dataclass(frozen=True)
class Parsed:
    """A parsed command line.

    command: the command. options: of its own class, or that of `flat_options`. json, cache_mb: those that are no part
    of a specification.
    """

    command: Command
    options: Any
    json: bool = False
    cache_mb: float | None = None

    @cached_property
    def spec(self) -> Any:
        """The specification; made when it is asked for, because plugins are registered only when a command runs.

        Raises:
            UsageError: the specification refuses a value.
        """
        if not self.command.spec:
            return self.options
        spec_type = load(self.command.options)
        values: dict[str, Any] = {}
        for option in options_of(spec_type):
            value = getattr(self.options, option.name)
            if not option.is_absent(value):
                _put(values, option.path, value)
        return _build(spec_type, values)


JSON = Option(
    "json", (), bool, False, Flag(), "Print one line of JSON at the end, for machines."
)
CACHE_MB = Option(
    "cache_mb",
    (),
    float | None,
    None,
    Flag(metavar="MB"),
    "Limit of the cache of homes, maps and episodes in memory [MB]; $MJHAB_CACHE_MB, else 512, if absent. Changes the "
    "speed, never the results.",
)


def parse_spec(
    command: Command, spec_type: type[Any], prog: str, args: Sequence[str]
) -> Parsed:
    """Parse the command line of a specification; exits with code 2 and a message if it does not fit.

    Args:
        command: the command.
        spec_type: class of its specification.
        prog: name of the command, for messages.
        args: the words after it.

    Raises:
        UsageError: a value is out of range.
    """
    given = tyro.cli(
        flat_options(command, spec_type),
        prog=prog,
        description=summary_of(spec_type),
        args=args,
        config=TYRO,
    )
    check_limits(given)
    return Parsed(command, given, given.json, getattr(given, "cache_mb", None))


def flat_options(command: Command, spec_type: type[Any]) -> type[Any]:
    """The dataclass of a command's options that tyro reads."""
    extra = [JSON, CACHE_MB] if command.memory else [JSON]
    fields = [option.as_field() for option in (*options_of(spec_type), *extra)]
    return dataclasses.make_dataclass("Options", fields, kw_only=True)


def options_of(spec_type: type[Any], path: tuple[str, ...] = ()) -> Iterator[Option]:
    """The options of a specification, in the order of its fields."""
    docs = field_docs(spec_type)
    for field, hint, marks in _fields(spec_type):
        flag = next((mark for mark in marks if isinstance(mark, Flag)), Flag())
        many = next((mark for mark in marks if isinstance(mark, OptionsOf)), None)
        here = (*path, field.name)
        if flag.hidden:
            continue
        if many is not None:
            yield from _optional(many, here)
        elif dataclasses.is_dataclass(hint):
            yield from options_of(typing.cast(type, hint), here)
        else:
            yield Option(
                flag.name or field.name,
                here,
                flag.kind or hint,
                _default(field),
                flag,
                docs.get(field.name, ""),
            )


def _optional(many: OptionsOf, path: tuple[str, ...]) -> Iterator[Option]:
    docs = {**field_docs(many.owner), **many.docs}
    for field, hint, marks in _fields(many.owner):
        flag = next((mark for mark in marks if isinstance(mark, Flag)), Flag())
        if field.name in many.apart or flag.hidden:
            continue
        flag = many.flag(field.name, flag)
        here = (*path, field.name)
        default = many.defaults.get(field.name, _default(field))
        if flag.kind is not None and dataclasses.is_dataclass(flag.kind):
            yield from _spread(flag, field.name, here, docs.get(field.name, ""))
            continue
        yield Option(
            flag.name or field.name,
            here,
            flag.kind or hint,
            default,
            flag,
            docs.get(field.name, ""),
            optional=True,
        )


def _spread(
    flag: Flag, name: str, path: tuple[str, ...], help_text: str
) -> Iterator[Option]:
    """The options of a field that holds a dataclass; the first field of that has the name of the option."""
    docs = field_docs(flag.kind)
    for number, (field, hint, marks) in enumerate(_fields(flag.kind)):
        inner = next((mark for mark in marks if isinstance(mark, Flag)), Flag())
        first = number == 0
        yield Option(
            (flag.name or name) if first else (inner.name or field.name),
            (*path, field.name),
            hint,
            _default(field),
            flag if first else inner,
            help_text if first else docs.get(field.name, ""),
            optional=True,
        )


def _fields(
    owner: type[Any],
) -> Iterator[tuple[dataclasses.Field[Any], Any, tuple[Any, ...]]]:
    """Fields of a dataclass with their types and the marks of their annotations."""
    hints = typing.get_type_hints(owner, include_extras=True)
    for field in dataclasses.fields(owner):
        hint = hints[field.name]
        marks: tuple[Any, ...] = ()
        if typing.get_origin(hint) is Annotated:
            hint, *rest = typing.get_args(hint)
            marks = tuple(rest)
        yield field, hint, marks


def _default(field: dataclasses.Field[Any]) -> Any:
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default


def _put(values: dict[str, Any], path: tuple[str, ...], value: Any) -> None:
    for name in path[:-1]:
        values = values.setdefault(name, {})
    values[path[-1]] = value


def _build(owner: type[Any], values: Mapping[str, Any]) -> Any:
    """A specification from nested mappings of its values."""
    made: dict[str, Any] = {}
    for field, hint, marks in _fields(owner):
        many = next((mark for mark in marks if isinstance(mark, OptionsOf)), None)
        if many is not None:
            made[field.name] = dict(_given(many, values.get(field.name, {})))
        elif field.name not in values:
            continue
        elif dataclasses.is_dataclass(hint):
            made[field.name] = _build(typing.cast(type, hint), values[field.name])
        else:
            made[field.name] = values[field.name]
    return owner(**made)


def _given(many: OptionsOf, values: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for field, _, marks in _fields(many.owner):
        if field.name in values:
            flag = next((mark for mark in marks if isinstance(mark, Flag)), Flag())
            value = values[field.name]
            spread = flag.kind is not None and dataclasses.is_dataclass(flag.kind)
            kind: Any = flag.kind
            yield field.name, kind(**value) if spread else value


def _in_words(value: Any) -> str:
    """A default for the help."""
    if value is None:
        return "that of the profile"
    if value in ("", (), {}):
        return "none"
    if isinstance(value, tuple):
        return " ".join(map(str, value))
    return str(value)


def _metavar(hint: Any) -> str:
    """What stands for a value of a type in the help."""
    origin = typing.get_origin(hint)
    if origin in (types.UnionType, typing.Union):
        kinds = [kind for kind in typing.get_args(hint) if kind is not types.NoneType]
        return "|".join(dict.fromkeys(_metavar(kind) for kind in kinds))
    if origin is tuple:
        kind, *rest = typing.get_args(hint)
        more = " ".join(_metavar(one) for one in rest if one is not Ellipsis)
        return f"{_metavar(kind)} {more or '...'}"
    return METAVARS.get(hint, getattr(hint, "__name__", str(hint)).upper())
