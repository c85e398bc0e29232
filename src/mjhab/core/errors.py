"""Errors at the boundary: what was given, what was expected, what to do next; and warnings that are given once."""

from __future__ import annotations

import difflib
import logging
import reprlib
from collections.abc import Iterable, Mapping

_REPR = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = 120
_REPR.maxlong = 40
_log = logging.getLogger("mjhab")
_told: set[str] = set()
"""Warnings that this process has given."""


class MjhabError(Exception):
    """Base of every error this package raises on purpose."""


class UsageError(MjhabError):
    """The caller gave something that cannot work; the message says what would."""


def shown(value: object) -> str:
    """A value for a message, on one line and no longer than fits there."""
    return " ".join(_REPR.repr(value).split())


def unknown_name(
    kind: str,
    given: object,
    valid: Iterable[str],
    elsewhere: Mapping[str, str] | None = None,
) -> UsageError:
    """Build the error for a name that is not in a closed list.

    Args:
        kind: what the name names, e.g. ``"task"``.
        given: the name that was asked for; whatever is no text is told as such.
        valid: every accepted name; "" is left out.
        elsewhere: names that other projects use, and a sentence about what to give here.
    """
    names = sorted(filter(None, valid))
    if not isinstance(given, str):
        told = f"{shown(given)} ({type(given).__name__})"
        return UsageError(
            f"{kind} must be a name, got {told}. Valid names: {', '.join(names)}."
        )
    if elsewhere and given in elsewhere:
        return UsageError(
            f"unknown {kind} {shown(given)}. {elsewhere[given]} Valid names: {', '.join(names)}."
        )
    near = difflib.get_close_matches(given, names, n=1, cutoff=0.4)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    return UsageError(
        f"unknown {kind} {shown(given)}.{hint} Valid names: {', '.join(names)}."
    )


def warn_once(text: str) -> None:
    """Log a warning to the logger ``mjhab``, unless this process has logged the same text before."""
    if text not in _told:
        _told.add(text)
        _log.warning(text)
