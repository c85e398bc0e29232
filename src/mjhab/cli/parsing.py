"""Command lines from specifications: every field of a dataclass, of dataclasses in it and of `OptionsOf` is an option.

tyro parses a flat dataclass that is made of the specification; `Parsed` holds the specification made of its values.
"""

from __future__ import annotations

import dataclasses
import json
import types
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import tyro

from mjhab.cli.commands import Command
from mjhab.cli.renamed import tell_old_values, with_own_options
from mjhab.core.errors import UsageError
from mjhab.core.typed.flags import (
    Flag,
    Keyed,
    OptionsOf,
    field_docs,
    hints_of,
    summary_of,
)

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

    name: without dashes, with underscores. path: of the value in the specification: names of fields, keys of mappings.
    hint: type. default: dataclasses.MISSING for an option that must be given; None of an option that may be absent and
    then is not part of the specification, see ``optional``. flag: what the annotation says. help: the docstring.
    keyed: for an option of which there is one for each key.
    """

    name: str
    path: tuple[str, ...]
    hint: Any
    default: Any
    flag: Flag
    help: str
    optional: bool = False
    keyed: Keyed | None = None

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
        shown = self.flag.shown or ("default: none" if default in ((), "", {}) else "")
        if self.flag.positional and default is dataclasses.MISSING:
            shown = "required"
        if self.keyed is not None:
            hint = str
        if self.optional and not self.is_switch:
            hint = hint | None
            shown = shown or f"default: {_in_words(default)}"
            # None tells an option that was not given from one with the value of its default.
            default = None
        flag = tyro.conf.arg(
            name=f"{self.name}.{self.keyed.key}" if self.keyed else self.name,
            metavar=(self.flag.metavar or _metavar(hint)) if self.takes_value else None,
            help=self.help,
            help_behavior_hint=f"({shown})" if shown else None,
        )
        annotation = Annotated[hint, flag]
        if self.flag.positional:
            annotation = tyro.conf.Positional[annotation]
        if default is dataclasses.MISSING:
            return (self.name, annotation, dataclasses.field())
        return (self.name, annotation, dataclasses.field(default=default))


@dataclass(frozen=True)
class Parsed:
    """A parsed command line.

    command: the command. values: of its specification, in nested mappings. json, cache_mb: options of all commands,
    which are no part of a specification. tells: whether the command is only printed, not run.
    """

    command: Command
    values: Mapping[str, Any]
    json: bool = False
    cache_mb: float | None = None
    tells: bool = False

    @cached_property
    def spec(self) -> Any:
        """The specification; made when it is asked for, because plugins are registered only when a command runs.

        Raises:
            UsageError: the specification refuses a value.
        """
        return _build(self.command.spec_type, self.values)


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


def parse_words(command: Command, words: Sequence[str]) -> Parsed:
    """Parse the words behind the name of a command; exits with code 2 and a message if they do not fit.

    Raises:
        UsageError: a word of the form --NAME.KEY has no value.
    """
    spec_type = command.spec_type
    options = list(options_of(spec_type))
    words = with_own_options(command.name, words, [o.name for o in options])
    # Their names are open, such as --perturb.NAME, and tyro knows closed lists only.
    words, entries = _without_keyed(words, options)
    extra = [JSON, CACHE_MB] if command.memory else [JSON]
    fields = [option.as_field() for option in (*options, *extra)]
    given = tyro.cli(
        # By keyword: fields without a default may follow others.
        dataclasses.make_dataclass("Options", fields, kw_only=True),
        prog=f"mjhab {command.name}",
        description=summary_of(spec_type),
        args=words,
        config=TYRO,
    )
    values: dict[str, Any] = {}
    for option in options:
        value = getattr(given, option.name)
        if option.keyed is None and not option.is_absent(value):
            _put(values, option.path, value)
    for path, value in entries:
        _put(values, path, value)
    tell_old_values(values)
    return Parsed(command, values, given.json, getattr(given, "cache_mb", None))


def options_of(spec_type: type[Any], path: tuple[str, ...] = ()) -> Iterator[Option]:
    """The options of a specification, in the order of its fields."""
    docs = field_docs(spec_type)
    for field, hint, marks in _fields(spec_type):
        flag = _mark(marks, Flag) or Flag()
        many = _mark(marks, OptionsOf)
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
    """The options of a mapping."""
    docs = {**field_docs(many.owner), **many.docs}
    for field, hint, marks in _fields(many.owner):
        flag = _mark(marks, Flag) or Flag()
        if not many.has(field.name) or flag.hidden:
            continue
        flag = many.flag(field.name, flag)
        name = flag.name or field.name
        about = docs.get(field.name, "")
        keyed = _mark(marks, Keyed)
        if flag.kind is not None and dataclasses.is_dataclass(flag.kind):
            yield from _spread(flag, name, (*path, name), about)
        else:
            default = many.defaults.get(field.name, _default(field))
            if keyed is not None:
                flag = dataclasses.replace(flag, metavar=keyed.metavar)
            kind = flag.kind or hint
            here = (*path, name)
            yield Option(name, here, kind, default, flag, about, True, keyed)


def _spread(
    flag: Flag, name: str, path: tuple[str, ...], help_text: str
) -> Iterator[Option]:
    """The options of a field that holds a dataclass; the first field of that has the name of the option."""
    docs = field_docs(flag.kind)
    for number, (field, hint, marks) in enumerate(_fields(flag.kind)):
        inner = _mark(marks, Flag) or Flag()
        first = number == 0
        yield Option(
            name if first else (inner.name or field.name),
            (*path, field.name),
            hint,
            _default(field),
            flag if first else inner,
            help_text if first else docs.get(field.name, ""),
            optional=True,
        )


def _without_keyed(
    words: Sequence[str], options: Iterable[Option]
) -> tuple[list[str], list[tuple[tuple[str, ...], Any]]]:
    """The words without those of keyed options, and the paths and values of these."""
    keyed = {
        f"--{option.name.replace('_', '-')}.": option
        for option in options
        if option.keyed
    }
    left: list[str] = []
    found: list[tuple[tuple[str, ...], Any]] = []
    rest = iter(words)
    for word in rest:
        name, equals, value = word.partition("=")
        start = f"{name.replace('_', '-').partition('.')[0]}."
        if "." not in name or start not in keyed:
            left.append(word)
            continue
        option = keyed[start]
        key = name.partition(".")[2].replace("-", "_")
        text = value if equals else next(rest, None)
        if text is None:
            raise UsageError(f"{name} needs a value.")
        assert option.keyed is not None
        keys = key.split(".") if "." in option.keyed.key else [key]
        found.append(((*option.path, *keys), _plain_value(text)))
    return left, found


def _plain_value(text: str) -> Any:
    """A number, true, false or a list as in JSON; any other text as it is."""
    try:
        return json.loads(text)
    except ValueError:
        return text


def _fields(
    owner: type[Any],
) -> Iterator[tuple[dataclasses.Field[Any], Any, tuple[Any, ...]]]:
    """Fields of a dataclass with their types and the marks of their annotations."""
    for field in dataclasses.fields(owner):
        hint = hints_of(owner)[field.name]
        marks: tuple[Any, ...] = ()
        if typing.get_origin(hint) is Annotated:
            hint, *rest = typing.get_args(hint)
            marks = tuple(rest)
        yield field, hint, marks


def _mark(marks: tuple[Any, ...], kind: type[Any]) -> Any:
    return next((mark for mark in marks if isinstance(mark, kind)), None)


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
        many = _mark(marks, OptionsOf)
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
    """The given entries of a mapping; dataclasses are made of their fields."""
    kinds = {
        flag.name or field.name: flag.kind
        for field, _, marks in _fields(many.owner)
        if (flag := _mark(marks, Flag)) and dataclasses.is_dataclass(flag.kind)
    }
    for name, value in values.items():
        kind: Any = kinds.get(name)
        yield name, value if kind is None else kind(**value)


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
