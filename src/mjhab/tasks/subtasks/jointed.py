"""Common part of Open and Close, which move the joint of a drawer or door to an end and the hand back to rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from mjhab.tasks.rewards.table import RewardTable
from mjhab.tasks.signals import JOINT_CHECKS
from mjhab.tasks.subtasks.event_lists import EXCESS, last
from mjhab.tasks.subtasks.spec import AT_REST, LabelRule, PublishedLabels, SubtaskSpec
from mjhab.tasks.thresholds import SubtaskConfig


@dataclass(frozen=True)
class JointNames:
    """Names of signals, which are events too, and of labels.

    Attributes:
        there: signal that the joint is at the wanted end.
        back: signal that the joint is at the other end.
        slightly: signal that the joint has left the other end.
        done: label of a success.
        undone: label of a failure in which the joint reached the wanted end and left it again.
        slight: label of a failure in which the joint only left the other end.
        unmoved: label of a failure in which the joint did not leave the other end.
    """

    there: str
    back: str
    slightly: str
    done: str
    undone: str
    slight: str
    unmoved: str


def label_rules(names: JointNames) -> tuple[LabelRule, ...]:
    """The labels of Open or Close, see `SubtaskSpec.label_rules`."""
    there = names.there
    return (
        LabelRule(
            "success_then_excessive_collisions",
            lambda s: s.ever("success") & s.ever("excess"),
        ),
        # Before the plain success, which it is a special case of.
        LabelRule("dubious_success", lambda s: s.ever("success") & ~s.holds(there)),
        LabelRule(names.done, lambda s: s.ever("success")),
        LabelRule("excessive_collision_failure", lambda s: s.ever("excess")),
        LabelRule("cant_reach_articulation_failure", lambda s: ~s.ever("ee_contact")),
        LabelRule(names.undone, lambda s: s.ever(there) & ~s.holds(there)),
        LabelRule("too_slow_failure", lambda s: s.ever(there)),
        LabelRule(names.slight, lambda s: s.ever(names.slightly)),
        LabelRule(names.unmoved),
    )


def published_labels(names: JointNames) -> PublishedLabels:
    """The labels of Open or Close as the published code gives them."""
    return PublishedLabels(
        events=("contact", names.there, "success", EXCESS, names.slightly, names.back),
        label=partial(_published_label, names),
        columns=(
            names.done,
            "dubious_success",
            "success_then_excessive_collisions",
            "excessive_collision_failure",
            "cant_reach_articulation_failure",
            names.undone,
            names.slight,
            "too_slow_failure",
            names.unmoved,
        ),
    )


def _published_label(
    names: JointNames, events: Sequence[str], success: bool, at_goal_first: bool
) -> str:
    """The rule for Open and Close of mshab/utils/label_dataset.py."""
    there = last(events, names.there)
    back = last(events, names.back)
    slightly = last(events, names.slightly)
    if success:
        if EXCESS in events:
            return "success_then_excessive_collisions"
        # By the order of events, as there; our own rules look at the last state instead.
        return "dubious_success" if back > there else names.done
    if EXCESS in events:
        return "excessive_collision_failure"
    if "contact" not in events:
        return "cant_reach_articulation_failure"
    if back > there and back > slightly:
        return names.undone
    if slightly > there:
        return names.slight
    return "too_slow_failure" if there >= 0 else names.unmoved


def jointed_subtask(names: JointNames, reward: RewardTable, **own: Any) -> SubtaskSpec:
    """Make the spec of Open or Close (MS-HAB paper App. A.2).

    Args:
        names: names of signals and labels.
        reward: the dense reward.
        own: fields of `SubtaskSpec` that differ between the two.
    """
    published = published_labels(names)
    return SubtaskSpec(
        about="link",
        # The paper's numbers (App. A.2; mshab/envs/planner.py).
        limits=SubtaskConfig(200, 10000.0),
        conditions=(names.there, *AT_REST),
        checks=JOINT_CHECKS,
        label_rules=label_rules(names),
        published=published,
        events=(*published.events, "lost_contact", "lost_success"),
        # Of Close, "opened" means no longer slightly closed, and the other way round: both are the falling edge.
        edges={names.back: f"-{names.slightly}"},
        reward=reward,
        **own,
    )
