"""Command lines in an old form: read for one version, with a line on stderr that says the new one."""

from __future__ import annotations

import sys
from collections.abc import Collection, Mapping, Sequence
from typing import Any

WORDS: Mapping[str, Mapping[str, str]] = {
    "score": {
        "--check": "score check",
        "--table": "score table",
        "--starts": "score starts",
    },
    "doctor": {"--estimate": "estimate"},
}
"""Options that became commands, by the command that had them."""
SPAWN_RULE = {"--starts": "--spawn-rule"}
OPTIONS: Mapping[str, Mapping[str, str]] = {
    "score check": {"--check-seed": "--seed"},
    "estimate": {"--num-envs": "--worlds"},
}
"""Old to new names of options, by command; those of `SPAWN_RULE` are of all commands that know the new one."""
VALUES: Mapping[str, Mapping[str, str]] = {"policy": {"student": "learned"}}
"""Old to new values, by option; behind a colon a value may go on."""


def with_command(words: Sequence[str]) -> list[str]:
    """A command line whose first words name the command of today."""
    for number, word in enumerate(words):
        name, equals, value = word.partition("=")
        new = WORDS.get(words[0], {}).get(name)
        if new is not None:
            _tell(f"mjhab {words[0]} {name}", f"mjhab {new}")
            rest = [*words[1:number], *([value] if equals else []), *words[number + 1 :]]
            return [*new.split(), *rest]
    return list(words)


def with_own_options(
    command: str, words: Sequence[str], names: Collection[str]
) -> list[str]:
    """The words behind the name of a command, with the names that its options have today.

    Args:
        command: its name.
        words: behind it.
        names: of its options, without dashes, with underscores.
    """
    known = {f"--{name.replace('_', '-')}" for name in names}
    new = {
        old: name
        for old, name in {**SPAWN_RULE, **OPTIONS.get(command, {})}.items()
        # A command may use the old name for something else today.
        if old not in known and name in known
    }
    found: list[str] = []
    for word in words:
        name, equals, value = word.partition("=")
        if name in new:
            _tell(name, new[name])
            word = f"{new[name]}{equals}{value}"
        found.append(word)
    return found


def tell_old_values(values: Mapping[str, Any]) -> None:
    """Tell of values that have another name today, by the options of a command that have them."""
    for option, names in VALUES.items():
        name, colon, _ = str(values.get(option, "")).partition(":")
        if name in names:
            what = f"--{option} "
            _tell(f"{what}{name}{colon}", f"{what}{names[name]}{colon}")


def _tell(old: str, new: str) -> None:
    print(
        f"mjhab: {old} is now {new}; the old form goes with the next version.",
        file=sys.stderr,
    )
