"""Specifications with options of environments: each is declared once, in `EnvConfig`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Self, cast

from mjhab.config.env import EnvConfig
from mjhab.core.errors import unknown_name
from mjhab.core.typed.flags import OptionsOf, flag_of, mark_of
from mjhab.core.typed.options import fitting, take_options, taken

PROFILE = ("profile", "robot", "spawn_rule", "stillness", "joint_dynamics")
"""Options of commands that make environments for a policy of their own."""


def env_options(
    *names: str,
    docs: Mapping[str, str] | None = None,
    shown: Mapping[str, str] | None = None,
    **defaults: Any,
) -> OptionsOf:
    """The mark of a field ``env`` with some fields of `EnvConfig`.

    Args:
        names: the fields.
        docs: what they mean here, where the docstrings of `EnvConfig` do not hold.
        shown: their defaults as the help tells them.
        **defaults: values in place of the defaults of `EnvConfig`.
    """
    return OptionsOf(
        EnvConfig, names, defaults=defaults, docs=docs or {}, shown=shown or {}
    )


def env_mark(spec_type: type[Any]) -> OptionsOf:
    """What the annotation of ``env`` of a specification says."""
    mark = mark_of(spec_type, "env", OptionsOf)
    assert mark is not None
    return mark


def env_names(spec_type: type[Any]) -> dict[str, str]:
    """Names of the environment options of a specification, those of the command line, too, to those of `EnvConfig`."""
    many = env_mark(spec_type)
    names: dict[str, str] = {}
    for option in dataclasses.fields(many.owner):
        if many.has(option.name):
            names[option.name] = option.name
            names[flag_of(many.owner, option.name).name or option.name] = option.name
    return names


class EnvSpec:
    """What specifications with a mapping ``env`` of given `EnvConfig` fields have in common."""

    WHAT: ClassVar[str] = ""
    """What is asked for, for messages about unknown options: "an evaluation"."""
    APART: ClassVar[frozenset[str]] = frozenset()
    """Fields that a specification checks itself."""

    env: Mapping[str, Any]

    @classmethod
    def of(cls, *args: Any, **options: Any) -> Self:
        """Make a specification of options that mix its own fields and those of `EnvConfig`.

        Args:
            *args: own fields, in order.
            **options: by name; ``out`` may be a string; environment options also by their names on the command line,
                such as ``worlds``.

        Raises:
            UsageError: an option is unknown or invalid; see the class.
        """
        own = {f.name for f in dataclasses.fields(cast(Any, cls))}
        further = {name: value for name, value in options.items() if name not in own}
        known = {name: value for name, value in options.items() if name in own}
        if further or "env" in known:
            known["env"] = {**_mapping(known.get("env")), **further}
        # Only `out` may be a text in Python, as callers write it; the command line makes paths of all others.
        if isinstance(known.get("out"), str):
            known["out"] = Path(known["out"])
        return cls(*args, **known)

    def __post_init__(self) -> None:
        take_options(self, {"env", *self.APART})
        self._take_env()

    def _take_env(self) -> None:
        """Give the environment options the names of `EnvConfig`, leave out those that are None, and check them.

        Raises:
            UsageError: an option is unknown or invalid.
        """
        names = env_names(type(self))
        own = [f.name for f in dataclasses.fields(cast(Any, self)) if f.name != "env"]
        env: dict[str, Any] = {}
        for name, value in _mapping(self.env).items():
            if name not in names:
                what = f"option of {self.WHAT}" if self.WHAT else "option"
                raise unknown_name(what, name, sorted({*names, *own}))
            # None means not given: it must not count as the user's own choice over what a policy asks for.
            if value is not None:
                env[names[name]] = value
                if name != names[name]:
                    # Named as the caller did, before `EnvConfig` names it as its own.
                    taken(EnvConfig, names[name], value, name)
        object.__setattr__(self, "env", env)
        # In its one plain form, so that specifications of the same pack are equal.
        if "assets" in env:
            env["assets"] = self.asked.assets

    @cached_property
    def asked(self) -> EnvConfig:
        """The environment as it was asked for, without the options that the policy needs."""
        return EnvConfig(**self.env_options)

    @property
    def env_options(self) -> dict[str, Any]:
        """The given options and the defaults that differ from those of `EnvConfig`."""
        return {**self.env_defaults, **self.env}

    @property
    def env_defaults(self) -> Mapping[str, Any]:
        """Defaults of environment options that differ from those of `EnvConfig`."""
        return env_mark(type(self)).defaults


def _mapping(env: Any) -> Mapping[str, Any]:
    """The options of an environment that were given.

    Raises:
        UsageError: they are no mapping with texts as keys.
    """
    return fitting("env", Mapping[str, Any], {} if env is None else env)
