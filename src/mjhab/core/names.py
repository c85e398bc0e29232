"""What a name in a file may look like, and paths that are made from names.

Names become parts of paths, of messages and of other files.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable
from pathlib import Path
from typing import Any

from mjhab.core.errors import UsageError, shown, wrong_value

MAX_NAME_CHARACTERS = 128
_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_./:-]*")


_EXPECTED_NAME = (
    f"a name of letters, digits and _ - . / : (at most {MAX_NAME_CHARACTERS}), without "
    "'..' and no absolute path"
)
_COPY = "_:"


def shortened(text: str, length: Callable[[str], float], most: float) -> str:
    """A text, cut off with three dots if its ``length`` is above ``most``."""
    if length(text) <= most:
        return text
    while text and length(text + "...") > most:
        # Letter by letter, since the width of a text in pixels does not follow from its number of letters.
        text = text[:-1]
    return text.rstrip() + "..."


def copy_name(kind: str, number: int) -> str:
    """Name of one of several copies of a thing, as HAB writes it: ``"024_bowl_:0003"``."""
    return f"{kind}{_COPY}{number:04d}"


def copy_names(kinds: Iterable[str]) -> tuple[str, ...]:
    """Names of things of the given kinds, the copies of every kind counted from 0."""
    seen: Counter[str] = Counter()
    names = []
    for kind in kinds:
        names.append(copy_name(kind, seen[kind]))
        seen[kind] += 1
    return tuple(names)


def kind_of(name: str) -> str:
    """What a name of `copy_name` is a copy of: ``"024_bowl"``; other names as they are."""
    return name.partition(_COPY)[0]


def check_name(what: str, name: Any, *, empty: bool = False) -> str:
    """Return a name that was read from a file, if it is one.

    Args:
        what: which name, for the message, such as ``"field 'home'"``.
        name: what the file holds.
        empty: "" is accepted, too.

    Raises:
        FieldError: no text; longer than `MAX_NAME_CHARACTERS`; other characters than ASCII letters, digits and
            ``_ - . / :``; a part that is empty or begins with a dot (so no ``..``); or an absolute path.
    """
    if isinstance(name, str) and len(name) <= MAX_NAME_CHARACTERS:
        if not name and empty:
            return name
        parts = name.split("/")
        if (
            _NAME.fullmatch(name)
            and ".." not in name
            and not any(part.startswith(".") or not part for part in parts)
        ):
            return name
    raise wrong_value(what, name, _EXPECTED_NAME)


def check_texts(what: str, texts: Any, where: str = "") -> None:
    """Check a sequence of texts; a plain text would be read letter by letter.

    Args:
        what: which field, for the message: "words".
        texts: what was given.
        where: what the field belongs to: "subtask 'push'".

    Raises:
        UsageError: it is a plain text, no sequence, or something in it is no text.
    """
    advice = f"Write ({shown(texts)},)." if isinstance(texts, str) else ""
    is_several = isinstance(texts, Collection) and not isinstance(texts, str)
    if not is_several or not all(isinstance(text, str) for text in texts):
        raise wrong_value(what, texts, "a tuple of texts", advice, where)


def below(root: Path, *parts: str | Path) -> Path:
    """The path ``root/parts...``, which lies below ``root``. Whoever makes a path from a name asks here.

    Raises:
        UsageError: it would lie elsewhere, because a part is absolute or has ``..`` in it.
    """
    path = root.joinpath(*parts)
    top = Path(os.path.normpath(root))
    inside = Path(os.path.normpath(path))
    # After the dots are resolved, which a look at the text could miss.
    if inside == top or not inside.is_relative_to(top):
        given = "/".join(map(str, parts))
        raise UsageError(
            f"{given!r} would be written outside of {root}; nothing was written."
        )
    return path
