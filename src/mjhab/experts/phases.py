"""Names of what scripts are doing, for recordings, the overlay of the viewer and errors.

A phase is a generator function that does one thing, such as "pull the door open". Scripts are made of phases by
``yield from``; which ones run is read off the suspended generators, so that a script keeps no record of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from types import CodeType, FrameType
from typing import Any, TypeVar

from mjhab.core.action_notes import Doing
from mjhab.core.errors import unknown_name

F = TypeVar("F", bound=Callable[..., Any])
PHASES: dict[CodeType, str] = {}
"""Name of every phase by the code of its function."""
SKILLS: tuple[str, ...] = (
    "approach",
    "grasp",
    "lift",
    "carry",
    "place",
    "release",
    "retract",
    "pull",
    "push",
    "drive",
    "hold",
)
"""What all phases of all scripts do, in few words for learners: "lift" of whatever lies wherever."""
_SKILL_OF: dict[CodeType, str] = {}


def phase(name: str, skill: str = "") -> Callable[[F], F]:
    """Name the phase that a generator function is, by what the robot does in it.

    ``skill``: one of `SKILLS`; "" for a phase that does what the one around it does, such as to drive into a shelf.

    Raises:
        UsageError: there is no such skill.
    """
    if skill and skill not in SKILLS:
        raise unknown_name("skill", skill, SKILLS)

    def named(function: F) -> F:
        # By the code, which a suspended generator still has; its function it does not.
        PHASES[function.__code__] = name
        if skill:
            _SKILL_OF[function.__code__] = skill
        return function

    return named


def frames_of(script: Generator[Any, Any, Any]) -> Iterator[FrameType]:
    """Frames of a suspended script and of the generators that it delegates to, outermost first."""
    inner: Any = script
    # Other iterators may be delegated to, and have no frame.
    while inner is not None and getattr(inner, "gi_frame", None) is not None:
        yield inner.gi_frame
        inner = inner.gi_yieldfrom


def phases_of(script: Generator[Any, Any, Any]) -> tuple[str, ...]:
    """Names of the phases that a suspended script is in, outermost first."""
    codes = (frame.f_code for frame in frames_of(script))
    return tuple(PHASES[code] for code in codes if code in PHASES)


def doing(script: Generator[Any, Any, Any]) -> Doing:
    """What a suspended script is doing: the skill of its innermost phase that has one, and all its phases."""
    codes = [frame.f_code for frame in frames_of(script)]
    # From the innermost outwards: a phase without a skill does what the one around it does.
    skill = next((_SKILL_OF[code] for code in reversed(codes) if code in _SKILL_OF), "")
    return Doing(skill, tuple(PHASES[code] for code in codes if code in PHASES))


def phases_in(error: BaseException) -> tuple[str, ...]:
    """Names of the phases in which an exception was raised, outermost first."""
    found = []
    at = error.__traceback__
    while at is not None:
        if at.tb_frame.f_code in PHASES:
            found.append(PHASES[at.tb_frame.f_code])
        at = at.tb_next
    return tuple(found)
