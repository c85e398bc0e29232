"""What tests ask of an error: its fields, not its wording."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from mjhab.cli.main import parse, run
from mjhab.core.errors import UsageError
from mjhab.data.select.query import FilterError

_ANY: Any = object()


@contextmanager
def refused(
    option: str = "",
    given: Any = _ANY,
    expected: str = "",
    where: object = "",
    advice: str = "",
    said: str | tuple[str, ...] = "",
) -> Iterator[pytest.ExceptionInfo[UsageError]]:
    """The block raises a UsageError of one line about an option or field.

    Args:
        option: the option, or what it is a part of: "floor" for "floor.size[0]".
        given: what it was given.
        expected: one of the valid names, or a part of the phrase that tells what would fit.
        where: a part of the name of the file or object that has the field.
        advice: a part of what the error says to do.
        said: what a message says that has no field for it, such as what is wrong with a file; several parts of it.
    """
    with pytest.raises(UsageError) as caught:
        yield caught
    error = caught.value
    text = str(error)
    # An error of a filter shows the column in a line of its own.
    assert ("\n" not in text or isinstance(error, FilterError)) and len(text) < 4000
    assert error.option in text and error.where in text
    if option:
        rest = error.option.removeprefix(option)
        assert error.option.startswith(option) and rest[:1] in ("", ".", "["), text
    if given is not _ANY:
        assert error.given == given, text
    assert not expected or expected in error.expected, (error.expected, text)
    assert str(where) in error.where, (error.where, text)
    assert advice in error.advice, (error.advice, text)
    for part in (said,) if isinstance(said, str) else said:
        assert part in text, text


def command(*args: object) -> int:
    """Run a command line in this process; errors are raised, which `mjhab.cli.main.main` tells in one line."""
    return run(parse(list(map(str, args))))
