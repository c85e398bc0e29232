"""Capabilities of a policy (reach, grasp, ...), derived from events and labels of its subtasks."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from mjhab.reports.metrics import wilson
from mjhab.rollout.records import SubtaskRecord

COLLISIONS = ("excessive_collision_failure", "success_then_excessive_collisions")


@dataclass(frozen=True)
class Capability:
    """A capability and how it is measured.

    counted: whether a subtask requires it. shown: whether a subtask demonstrates it. meaning: description.
    """

    counted: Callable[[SubtaskRecord], bool]
    shown: Callable[[SubtaskRecord], bool]
    meaning: str


def _has(record: SubtaskRecord, event: str) -> bool:
    return any(name == event for _, name in record.events)


CAPABILITIES: dict[str, Capability] = {
    "reach": Capability(
        lambda r: r.kind in ("pick", "open"),
        lambda r: _has(r, "contact"),
        "Pick and Open in which the fingers touch the object or the handle",
    ),
    "grasp": Capability(
        lambda r: r.kind == "pick",
        lambda r: _has(r, "grasped"),
        "Pick in which the object is held",
    ),
    "carry": Capability(
        lambda r: r.kind == "place",
        lambda r: _has(r, "at_goal"),
        "Place in which the object arrives at its goal",
    ),
    "articulate": Capability(
        lambda r: r.kind in ("open", "close"),
        lambda r: r.success_once,
        "Open and Close that succeed",
    ),
    "navigate": Capability(
        lambda r: r.kind == "navigate", lambda r: r.success_once, "Navigate that succeeds"
    ),
    "under force limit": Capability(
        lambda r: True,
        lambda r: r.label not in COLLISIONS,
        "subtasks in which the robot's collisions stay below the limit",
    ),
}


def capabilities_of(record: SubtaskRecord) -> list[str]:
    """Names of the capabilities that a subtask demonstrates."""
    return [
        name
        for name, each in CAPABILITIES.items()
        if each.counted(record) and each.shown(record)
    ]


def profile(records: Iterable[SubtaskRecord]) -> dict[str, dict[str, object]]:
    """Fraction of the subtasks that show each capability, with its Wilson 95 % interval.

    Returns:
        By capability {"rate", "interval", "subtasks"}; the rate is None if no subtask requires the capability.
    """
    records = list(records)
    found: dict[str, dict[str, object]] = {}
    for name, capability in CAPABILITIES.items():
        counted = [record for record in records if capability.counted(record)]
        shown = sum(capability.shown(record) for record in counted)
        rate = round(shown / len(counted), 4) if counted else None
        interval = list(wilson(shown, len(counted)))
        found[name] = {"rate": rate, "interval": interval, "subtasks": len(counted)}
    return found
