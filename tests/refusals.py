"""What tests ask of an error: its fields, not its wording."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from mjhab.core.errors import UsageError

_ANY: Any = object()


@contextmanager
def refused(
    option: str = "",
    given: Any = _ANY,
    expected: str = "",
    where: object = "",
    said: str = "",
) -> Iterator[pytest.ExceptionInfo[UsageError]]:
    """The block raises a UsageError of one line about an option or field.

    Args:
        option: the option, or what it is a part of: "floor" for "floor.size[0]".
        given: what it was given.
        expected: one of the valid names, or a part of the phrase that tells what would fit.
        where: a part of the name of the file or object that has the field.
        said: what a message without fields says, such as the next move.
    """
    with pytest.raises(UsageError) as caught:
        yield caught
    error = caught.value
    text = str(error)
    assert "\n" not in text and len(text) < 4000
    assert error.option in text and error.where in text
    if option:
        rest = error.option.removeprefix(option)
        assert error.option.startswith(option) and rest[:1] in ("", ".", "["), text
    if given is not _ANY:
        assert error.given == given, text
    assert not expected or expected in error.expected, (error.expected, text)
    assert str(where) in error.where, (error.where, text)
    assert said in text, text
