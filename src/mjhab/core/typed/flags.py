"""Fields of specifications as options of the command line: what their annotations say besides the type.

A specification is a dataclass that a function of the library takes, such as `EvalSpec` of `mjhab.evaluate`. The command
line (`cli.parsing`) makes an option of each of its fields, with the field's docstring as help.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import textwrap
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, TypeVar


@dataclass(frozen=True)
class Flag:
    """How a field appears on the command line, in its annotation: ``Annotated[int, Flag("worlds", "N")]``.

    name: of the option, without dashes; "" for that of the field.
    metavar: what stands for its value in the help; "" for the type.
    kind: type that the command line reads in place of the field's, e.g. str where Python takes objects, too. A
        dataclass: its first field has the name of the option, its other fields are options, too.
    hidden: there is no such option; only Python sets the field.
    shown: the default as the help tells it; "" for the field's.
    positional: its values are words without an option before them.
    """

    name: str = ""
    metavar: str = ""
    kind: Any = None
    hidden: bool = False
    shown: str = ""
    positional: bool = False


@dataclass(frozen=True)
class Keyed:
    """Marks a field that is a mapping, each entry of which is an option: ``--overrides.goal_type cylinder``.

    key: what stands for the key of an entry in the help; with a dot for a mapping of mappings. metavar: for its value.
    """

    key: str
    metavar: str = "VALUE"


@dataclass(frozen=True)
class OptionsOf:
    """Marks a field that is a mapping of given fields of a dataclass, each of which is an option that may be absent.

    owner: the dataclass.
    names: its fields that are options; () for all.
    apart: its fields that are no options.
    defaults: values in place of the owner's defaults, for the help.
    docs: by field, what it means here, where the owner's docstring does not hold.
    shown: by field, the default as the help tells it.
    """

    owner: type[Any]
    names: tuple[str, ...] = ()
    apart: frozenset[str] = frozenset()
    defaults: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    docs: Mapping[str, str] = dataclasses.field(default_factory=dict)
    shown: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def has(self, name: str) -> bool:
        """Whether a field of the owner is an option."""
        return name not in self.apart and (not self.names or name in self.names)

    def flag(self, name: str, own: Flag) -> Flag:
        """The flag of an option, whose field has the flag ``own``."""
        shown = "" if name in self.defaults else own.shown
        return dataclasses.replace(own, shown=self.shown.get(name, shown))


Mark = TypeVar("Mark")


def mark_of(owner: type[Any], name: str, kind: type[Mark]) -> Mark | None:
    """The mark of a kind in the annotation of a field; None if it has none.

    A subclass that gives a field another default keeps the marks of its base.
    """
    hints = (hints_of(base).get(name) for base in owner.__mro__)
    marks = (
        mark
        for hint in hints
        if typing.get_origin(hint) is Annotated
        for mark in typing.get_args(hint)[1:]
    )
    return next((mark for mark in marks if isinstance(mark, kind)), None)


@cache
def hints_of(owner: type[Any]) -> Mapping[str, Any]:
    """The annotations of a dataclass with their marks, by field."""
    return typing.get_type_hints(owner, include_extras=True)


def flag_of(owner: type[Any], name: str) -> Flag:
    """What the annotation of a field says about its option."""
    return mark_of(owner, name, Flag) or Flag()


@cache
def field_docs(owner: type[Any]) -> Mapping[str, str]:
    """The docstrings below the fields of a dataclass and of its bases, one line each, by name."""
    found: dict[str, str] = {}
    for base in reversed(owner.__mro__):
        if dataclasses.is_dataclass(base):
            found |= _own_docs(base)
    return found


def _own_docs(owner: type[Any]) -> dict[str, str]:
    source = textwrap.dedent(inspect.getsource(owner))
    body = ast.parse(source).body[0]
    assert isinstance(body, ast.ClassDef)
    found: dict[str, str] = {}
    for field, after in zip(body.body, body.body[1:], strict=False):
        if not isinstance(field, ast.AnnAssign) or not isinstance(field.target, ast.Name):
            continue
        if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
            found[field.target.id] = " ".join(str(after.value.value).split())
    return found


def summary_of(owner: type[Any]) -> str:
    """The docstring of a class without its sections "Args:", "Raises:" and "Attributes:"."""
    text = inspect.cleandoc(owner.__doc__ or "")
    for section in ("\nArgs:", "\nRaises:", "\nAttributes:"):
        text = text.partition(section)[0]
    return text.strip()
