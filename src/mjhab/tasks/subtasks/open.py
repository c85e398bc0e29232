"""The subtask Open: open a drawer or door and bring the hand back to rest.

MS-HAB paper App. A.2; mshab/envs/open.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from mjhab.core.arrays import Array, namespace
from mjhab.tasks.rewards.table import (
    ALWAYS,
    RewardTable,
    RewardView,
    Term,
    joint_speed,
    near,
    posture_error,
    rest_distance,
    share_left,
)
from mjhab.tasks.subtasks.event_lists import EXCESS, JOINT_CHECKS, JointWords, joint_label
from mjhab.tasks.subtasks.spec import AT_REST, LabelRule, PublishedLabels, SubtaskSpec
from mjhab.tasks.thresholds import SubtaskConfig, TaskConfig

STARTED = 0.01
"""The joint has left its closed end by so much [m or rad]."""

OPEN_TERMS = (
    Term("reach", 3.0, "reaching", "hand to the handle: 1 - tanh(d)"),
    Term("grasp", 5.0, "gripping", "the handle is grasped, in place of reach"),
    Term("opened", 6.0, "opened", "the link is open, in place of reach and grasp"),
    Term(
        "progress", 6.0, ALWAYS, "share of the way from closed to the opening that counts as open"
    ),
    Term("started", 3.0, "started", "the joint has left its closed end by 0.01"),
    Term("gentle", 3.0, "gentle", "the joint moves at 2 rad/s (door), 1 m/s (drawer) or less"),
    Term("posture", 2.0, "opened", "torso, head and arm to rest: 1 - tanh(|q - rest|)"),
    Term("torso_up", 1.0, "opened", "height of the torso as a share of its travel"),
    Term("rest", 2.0, "opened", "hand to its rest point: 1 - tanh(d)"),
    Term("still", 1.0, "resting", "joint speeds: 1 - tanh(|qd|)"),
    Term("success", 3.0, "success", "the subtask is achieved"),
)

_OPEN_SHARPNESS = {"reach": 1.0, "posture": 1.0, "rest": 1.0, "still": 1.0}


def _open(
    view: RewardView, config: TaskConfig, published: bool = False
) -> tuple[dict[str, Array], dict[str, Array]]:
    world = view.world
    signals = view.signals
    distances = {
        "reach": view.handle_distance,
        "posture": posture_error(world, config),
        "rest": rest_distance(world, config),
        "still": joint_speed(world, config),
    }
    raw = near(_OPEN_SHARPNESS, distances)
    way = view.open_frac * (world.joint_max - world.joint_min)
    opening = world.joint_q - world.joint_min
    raw["progress"] = 1 - share_left(way - opening, way, bounded=not published)
    raw["torso_up"] = view.torso_up
    opened = signals.opened
    grasped = signals.is_grasped
    # The original compares the velocity itself: a door that falls shut counts as gentle.
    speed = view.joint_qd if published else namespace(opening).abs(view.joint_qd)
    when = {
        "reaching": ~(opened | grasped),
        "gripping": grasped & ~opened,
        "opened": opened,
        "started": opening > STARTED,
        "gentle": speed <= view.joint_ideal,
        "resting": opened & signals.ee_rest & signals.robot_rest,
        "success": signals.success,
    }
    return when, raw


REWARD = RewardTable(
    OPEN_TERMS,
    cases=(
        ("gentle", "started", "reaching"),
        ("gentle", "started", "gripping"),
        ("gentle", "started", "opened", "resting", "success"),
    ),
    published=27.0,
    raw=_open,
    reads=("joint",),
    raw_published=partial(_open, published=True),
)

LABEL_RULES = (
    LabelRule("success_then_excessive_collisions", lambda s: s.ever("success") & s.ever("excess")),
    LabelRule("dubious_success", lambda s: s.ever("success") & ~s.holds("opened")),
    LabelRule("open_success", lambda s: s.ever("success")),
    LabelRule("excessive_collision_failure", lambda s: s.ever("excess")),
    LabelRule("cant_reach_articulation_failure", lambda s: ~s.ever("ee_contact")),
    LabelRule("closed_after_open_failure", lambda s: s.ever("opened") & ~s.holds("opened")),
    LabelRule("too_slow_failure", lambda s: s.ever("opened")),
    LabelRule("slightly_open_failure", lambda s: s.ever("slightly_opened")),
    LabelRule("cant_open_failure"),
)


def _published_label(events: Sequence[str], success: bool, at_goal_first: bool) -> str:
    """The rules for Open of mshab/utils/label_dataset.py."""
    return joint_label(
        events,
        success,
        JointWords(
            there="opened",
            back="closed",
            slightly="slightly_opened",
            done="open_success",
            undone="closed_after_open_failure",
            slight="slightly_open_failure",
            unmoved="cant_open_failure",
        ),
    )


PUBLISHED = PublishedLabels(
    events=("contact", "opened", "success", EXCESS, "slightly_opened", "closed"),
    label=_published_label,
    columns=(
        "open_success",
        "dubious_success",
        "success_then_excessive_collisions",
        "excessive_collision_failure",
        "cant_reach_articulation_failure",
        "closed_after_open_failure",
        "slightly_open_failure",
        "too_slow_failure",
        "cant_open_failure",
    ),
)

OPEN = SubtaskSpec(
    name="open",
    words=("open {link}", "pull {link} open"),
    color="#f59e0b",
    about="link",
    limits=SubtaskConfig(200, 10000.0),
    conditions=("opened", *AT_REST),
    checks=JOINT_CHECKS,
    label_rules=LABEL_RULES,
    published=PUBLISHED,
    events=(*PUBLISHED.events, "lost_contact", "lost_success"),
    edges={"closed": "-slightly_opened"},
    reward=REWARD,
    shows=("object", "goal"),
    start="mjhab.episodes.starts.open:START",
    expert="mjhab.experts.skills.articulated:open_link",
)
