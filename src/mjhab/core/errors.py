"""Errors at the boundary: what was given, what was expected, what to do next; and warnings that are given once."""

from __future__ import annotations

import difflib
import logging
import reprlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager

_REPR = reprlib.Repr()
# A message is one line; a value of pages would bury what is wrong with it.
_REPR.maxstring = _REPR.maxother = 120
_REPR.maxlong = 40
_log = logging.getLogger("mjhab")
_warned: set[str] = set()
"""Warnings that this process has given."""


class MjhabError(Exception):
    """Base of every error this package raises on purpose."""


class UsageError(MjhabError):
    """The caller gave something that cannot work; the message says what would.

    Attributes:
        option: what is at fault: an option, an argument, a field, a key of a file; "" if the error is about none.
        given: what it was given; None where the message alone tells.
        expected: the valid names, or a phrase such as ``"at least 1"``; "" where the message alone tells.
        where: the file or object that has the field; "" for none.
        advice: what to do, a sentence; "" if that is clear, or the message alone tells.
    """

    def __init__(
        self,
        message: str,
        *,
        option: str = "",
        given: object = None,
        expected: str | tuple[str, ...] = "",
        where: str = "",
        advice: str = "",
    ) -> None:
        super().__init__(message)
        self.option = option
        self.given = given
        self.expected = expected
        self.where = where
        self.advice = advice


class FieldError(UsageError, ValueError):
    """A value does not fit its field; whoever knows the file that holds it tells so with `about`."""


def shown(value: object) -> str:
    """A value for a message, on one line and no longer than fits there."""
    return " ".join(_REPR.repr(value).split())


def fault(where: object, problem: str) -> UsageError:
    """Build the error for what is wrong in a file, an object or a part of the program, where no single value is.

    Args:
        where: the file or object, which the message begins with.
        problem: what is wrong there, and what to do.
    """
    return UsageError(_placed(where, problem), where=str(where))


def _placed(where: object, message: str) -> str:
    return f"{where}: {message}" if where else message


def wrong_value(
    option: str,
    given: object,
    expected: str | tuple[str, ...],
    advice: str = "",
    where: object = "",
) -> FieldError:
    """Build the error for a value that an option or field cannot have: the one form of these messages.

    Args:
        option: what has the value.
        given: the value.
        expected: what would fit, as a phrase that follows "must be", or the names that would.
        advice: what to do, a sentence; "" if that is clear.
        where: the file or object that has the field; "" for none.
    """
    return _refusal(option, given, expected, shown(given), advice, where)


def wrong_type(
    option: str, given: object, expected: str, advice: str = "", where: object = ""
) -> FieldError:
    """Build the error for a value of another type than expected; the message names its type, too. See `wrong_value`."""
    given_text = f"{shown(given)} ({type(given).__name__})"
    return _refusal(option, given, expected, given_text, advice, where)


def _refusal(
    option: str,
    given: object,
    expected: str | tuple[str, ...],
    given_text: str,
    advice: str,
    where: object,
) -> FieldError:
    wanted = expected if isinstance(expected, str) else " or ".join(expected)
    message = _joined(f"{option} must be {wanted}, got {given_text}.", advice)
    return FieldError(
        _placed(where, message),
        option=option,
        given=given,
        expected=expected,
        where=str(where),
        advice=advice,
    )


def missing_field(name: str, where: object = "", advice: str = "") -> FieldError:
    """Build the error for a field that a file or object ``where`` must have; ``advice``: what to do, a sentence."""
    message = _placed(where, _joined(f"field {name!r} is missing.", advice))
    return FieldError(
        message, option=name, expected="given", where=str(where), advice=advice
    )


def unknown_name(
    kind: str,
    given: object,
    valid: Iterable[str],
    elsewhere: Mapping[str, str] | None = None,
    where: object = "",
    advice: str = "",
) -> FieldError:
    """Build the error for a name that is not in a closed list.

    Args:
        kind: what the name names, e.g. ``"task"``.
        given: the name that was asked for; whatever is no text is told as such.
        valid: every accepted name; "" is left out.
        elsewhere: names that other projects use, and a sentence about what to give here.
        where: the file or object that has the name; "" for none.
        advice: what to do, a sentence; "" if the list of names is all there is to say.
    """
    # The empty name stands for a default, and is nothing to type.
    names = tuple(sorted(filter(None, valid)))
    if not isinstance(given, str):
        said = f"{kind} must be a name, got {shown(given)} ({type(given).__name__})."
    elif elsewhere and given in elsewhere:
        said = f"unknown {kind} {shown(given)}. {elsewhere[given]}"
    else:
        # Below the library's own 0.6, so that short names with two slips are still found.
        near = difflib.get_close_matches(given, names, n=1, cutoff=0.4)
        hint = f"Did you mean {near[0]!r}?" if near else ""
        said = _joined(f"unknown {kind} {shown(given)}.", hint)
    message = _joined(f"{said} Valid names: {', '.join(names)}.", advice)
    return FieldError(
        _placed(where, message),
        option=kind,
        given=given,
        expected=names,
        where=str(where),
        advice=advice,
    )


def _joined(*sentences: str) -> str:
    return " ".join(filter(None, sentences))


@contextmanager
def about(
    where: object,
    kinds: type[Exception] | tuple[type[Exception], ...] = ValueError,
    advice: str = "",
) -> Iterator[None]:
    """Errors from inside become a UsageError that names the file or object they are about, and keeps their fields.

    Args:
        where: the file or object.
        kinds: which errors; a `FieldError` is a ValueError.
        advice: what to do, a sentence.
    """
    try:
        yield
    except kinds as error:
        message = _joined(f"{where}: {str(error).removesuffix('.')}.", advice)
        # An error of a library has no fields to keep.
        if not isinstance(error, UsageError):
            raise UsageError(message, where=str(where), advice=advice) from error
        raise UsageError(
            message,
            option=error.option,
            given=error.given,
            expected=error.expected,
            where=_placed(where, error.where) if error.where else str(where),
            advice=_joined(error.advice, advice),
        ) from error


def warn_once(text: str) -> None:
    """Log a warning to the logger ``mjhab``, unless this process has logged the same text before."""
    # By the text: the same warning with another name in it is another one.
    if text not in _warned:
        _warned.add(text)
        _log.warning(text)
