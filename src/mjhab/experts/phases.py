"""Names of what scripts are doing, for the overlay of the viewer and for errors.

A phase is a generator function that does one thing, such as "pull the door open". Scripts are made of phases by
``yield from``; which ones run is read off the suspended generators, so that a script keeps no record of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from types import CodeType, FrameType
from typing import Any, TypeVar

F = TypeVar("F", bound=Callable[..., Any])
PHASES: dict[CodeType, str] = {}
"""Name of every phase by the code of its function."""


def phase(name: str) -> Callable[[F], F]:
    """Name the phase that a generator function is, by what the robot does in it."""

    def named(function: F) -> F:
        PHASES[function.__code__] = name
        return function

    return named


def frames_of(script: Generator[Any, Any, Any]) -> Iterator[FrameType]:
    """Frames of a suspended script and of the generators that it delegates to, outermost first."""
    inner: Any = script
    while inner is not None and getattr(inner, "gi_frame", None) is not None:
        yield inner.gi_frame
        inner = inner.gi_yieldfrom


def phases_of(script: Generator[Any, Any, Any]) -> tuple[str, ...]:
    """Names of the phases that a suspended script is in, outermost first."""
    codes = (frame.f_code for frame in frames_of(script))
    return tuple(PHASES[code] for code in codes if code in PHASES)


def phases_in(error: BaseException) -> tuple[str, ...]:
    """Names of the phases in which an exception was raised, outermost first."""
    found = []
    at = error.__traceback__
    while at is not None:
        if at.tb_frame.f_code in PHASES:
            found.append(PHASES[at.tb_frame.f_code])
        at = at.tb_next
    return tuple(found)
