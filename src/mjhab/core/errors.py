"""Errors at the boundary: what was given, what was expected, what to do next."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class MjhabError(Exception):
    """Base of every error this package raises on purpose."""


class UsageError(MjhabError):
    """The caller gave something that cannot work; the message says what would."""


def unknown_name(kind: str, given: str, valid: Iterable[str]) -> UsageError:
    """Build the error for a name that is not in a closed list.

    Args:
        kind: what the name names, e.g. ``"task"``.
        given: the name that was asked for.
        valid: every accepted name.
    """
    names = sorted(valid)
    near = difflib.get_close_matches(str(given), names, n=1, cutoff=0.4)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    return UsageError(f"unknown {kind} {given!r}.{hint} Valid names: {', '.join(names)}.")
