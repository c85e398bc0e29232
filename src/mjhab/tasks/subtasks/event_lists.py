"""Common functions for the labels of the published code, which are rules on the counts and order of events."""

from __future__ import annotations

from collections.abc import Sequence

EXCESS = "excessive_collisions"


def last(events: Sequence[str], name: str) -> int:
    """Index of the last occurrence of an event, -1 if there is none."""
    return max((i for i, event in enumerate(events) if event == name), default=-1)
