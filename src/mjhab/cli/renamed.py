"""Options with a new name: the old one is read for one version, with a line that says the new one."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence

RENAMED: Mapping[str, Mapping[str, str]] = {
    "eval": {"--starts": "--spawn-rule"},
    "generate": {"--starts": "--spawn-rule"},
    "view": {"--starts": "--spawn-rule"},
    "train": {"--starts": "--spawn-rule"},
}
"""Old to new names, by the first word of the command."""


def with_new_names(args: Sequence[str]) -> list[str]:
    """A command line with the new names of its options; a line on stderr says what changed."""
    new = RENAMED.get(args[0], {})
    found = []
    for word in args:
        name, equals, value = word.partition("=")
        if name in new:
            print(
                f"mjhab: {name} is called {new[name]} now; the old name goes with the next version.",
                file=sys.stderr,
            )
            word = f"{new[name]}{equals}{value}"
        found.append(word)
    return found
