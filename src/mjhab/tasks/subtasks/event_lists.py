"""What the labels of the published code share: they are counts and orders over lists of events."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

EXCESS = "excessive_collisions"
JOINT_CHECKS = ("opened", "closed", "slightly_opened", "slightly_closed")
"""Checks that mean something for subtasks that move a joint."""


def last(events: Sequence[str], name: str) -> int:
    """Index of the last occurrence of an event, -1 if there is none."""
    return max((i for i, event in enumerate(events) if event == name), default=-1)


@dataclass(frozen=True)
class JointWords:
    """Names of Open or Close in `joint_label`. Events: there, back, slightly; labels: done, undone, slight, unmoved."""

    there: str
    back: str
    slightly: str
    done: str
    undone: str
    slight: str
    unmoved: str


def joint_label(events: Sequence[str], success: bool, words: JointWords) -> str:
    """The rule for Open and Close of mshab/utils/label_dataset.py."""
    there = last(events, words.there)
    back = last(events, words.back)
    slightly = last(events, words.slightly)
    if success:
        if EXCESS in events:
            return "success_then_excessive_collisions"
        return "dubious_success" if back > there else words.done
    if EXCESS in events:
        return "excessive_collision_failure"
    if "contact" not in events:
        return "cant_reach_articulation_failure"
    if back > there and back > slightly:
        return words.undone
    if slightly > there:
        return words.slight
    return "too_slow_failure" if there >= 0 else words.unmoved
