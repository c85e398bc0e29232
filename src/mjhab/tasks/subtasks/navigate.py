"""The subtask Navigate: drive to where the next subtask is done, with or without an object.

MS-HAB paper App. A.2; mshab/envs/navigate.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from mjhab.core.arrays import Array, namespace, norm3
from mjhab.core.joints import BASE, BASE_X, BASE_Y, BASE_YAW
from mjhab.tasks.label_state import LabelState
from mjhab.tasks.rewards.table import (
    ALWAYS,
    RewardTable,
    RewardView,
    Term,
    above_zero,
    force_excess,
    joint_speed,
    near,
    posture_error,
    rest_distance,
)
from mjhab.tasks.subtasks.event_lists import EXCESS
from mjhab.tasks.subtasks.spec import AT_REST, LabelRule, PublishedLabels, SubtaskSpec
from mjhab.tasks.thresholds import SubtaskConfig, TaskConfig

FORCE_PER_NEWTON = 0.005
"""Scale of contact forces [1/N]; with FREE_FORCE, forces below 40 N are free."""
TRAIN_HORIZON_STEPS = 1000
"""Horizon in training, longer than in evaluation (mshab/envs/navigate.py)."""

NAVIGATE_TERMS = (
    Term("ready", 2.0, "ready", "what must be carried is grasped, or nothing has to be"),
    Term("approach", 8.0, "far", "way to the goal: 1 - tanh(d / 10)"),
    Term("forward", 2.0, "far", "forward speed of the base: tanh(2 max(v, 0))"),
    Term("arrived", 12.0, "near", "close to the goal, in place of approach and forward"),
    Term("heading", 2.0, "misaligned", "goal ahead: 1 - tanh(|bearing| / 2)"),
    Term("aligned", 2.0, "aligned", "facing the goal, in place of heading"),
    Term("base_still", 2.0, "aligned", "base speed: 1 - tanh(v / 3)"),
    Term(
        "still",
        1.0,
        "settled",
        "joint speeds: 1 - tanh(|qd|), with the hand at its rest point",
    ),
    Term(
        "force",
        5.0,
        ALWAYS,
        "contact force over 40 N: 1 - tanh(3 (max(0.005 F, 0.2) - 0.2))",
    ),
    Term("posture", 2.0, ALWAYS, "torso, head and arm to rest: 1 - tanh(|q - rest| / 5)"),
    Term("rest", 2.0, ALWAYS, "hand to its rest point: 1 - tanh(3 d)"),
)

_SHARPNESS = {
    "approach": 0.1,
    "forward": 2.0,
    "heading": 0.5,
    "base_still": 1 / 3,
    "still": 1.0,
    "force": 3.0,
    "posture": 0.2,
    "rest": 3.0,
}


def _navigate(
    view: RewardView, config: TaskConfig
) -> tuple[dict[str, Array], dict[str, Array]]:
    world = view.world
    signals = view.signals
    xp = namespace(world.base_pose)
    cos = xp.cos(world.base_pose[:, BASE_YAW])
    sin = xp.sin(world.base_pose[:, BASE_YAW])
    dx = view.goal_pos[:, 0] - world.base_pose[:, BASE_X]
    dy = view.goal_pos[:, 1] - world.base_pose[:, BASE_Y]
    bearing = xp.atan2(cos * dy - sin * dx, cos * dx + sin * dy)
    distances = {
        "approach": view.nav_distance,
        "forward": above_zero(
            cos * world.robot_qd[:, BASE_X] + sin * world.robot_qd[:, BASE_Y]
        ),
        "heading": xp.abs(bearing),
        "base_still": norm3(world.robot_qd[:, BASE]),
        "still": joint_speed(world, config),
        "force": force_excess(signals.robot_force, FORCE_PER_NEWTON),
        "posture": posture_error(world, config),
        "rest": rest_distance(world, config),
    }
    raw = near(_SHARPNESS, distances)
    # The term grows with the speed, while all others fall with a distance.
    raw["forward"] = 1 - raw["forward"]
    # Without the object that must be carried no progress is rewarded.
    ready = signals.is_grasped | ~signals.must_hold
    near_goal = ready & signals.near
    aligned = near_goal & signals.oriented
    when = {
        "ready": ready,
        "far": ready & ~signals.near,
        "near": near_goal,
        "misaligned": near_goal & ~signals.oriented,
        "aligned": aligned,
        "settled": aligned & signals.ee_rest,
    }
    return when, raw


REWARD = RewardTable(
    NAVIGATE_TERMS,
    cases=(
        ("ready", "far"),
        ("ready", "near", "misaligned"),
        ("ready", "near", "aligned", "settled"),
    ),
    published=28.0,
    raw=_navigate,
    reads=("nav_distance",),
)


def _has_lost(s: LabelState) -> Array:
    """(W,) bool: the object to carry is not held."""
    return s.must_hold & ~s.holds("is_grasped")


LABEL_RULES = (
    LabelRule(
        "success_then_excessive_collisions",
        lambda s: s.ever("success") & s.ever("excess"),
    ),
    LabelRule("success_then_dropped", lambda s: s.ever("success") & _has_lost(s)),
    LabelRule("navigation_success", lambda s: s.ever("success")),
    LabelRule("excessive_collision_failure", lambda s: s.ever("excess")),
    LabelRule("dropped_failure", lambda s: _has_lost(s)),
    LabelRule("navigation_failure"),
)


def _published_label(events: Sequence[str], success: bool, at_goal_first: bool) -> str:
    """The rule for Navigate of mshab/utils/label_dataset.py."""
    if EXCESS in events:
        return (
            "success_then_excessive_collisions"
            if success
            else "excessive_collision_failure"
        )
    if "dropped" in events:
        return "success_then_dropped" if success else "dropped_failure"
    return "navigation_success" if success else "navigation_failure"


PUBLISHED = PublishedLabels(
    events=("navigated_close", "grasped", "dropped", "success", EXCESS),
    label=_published_label,
)

NAVIGATE = SubtaskSpec(
    name="navigate",
    words=("go to {destination}", "drive to {destination}", "move to {destination}"),
    color="#94a3b8",
    about="way",
    # No force limit: the original stops no drive that touches furniture (mshab/envs/planner.py).
    limits=SubtaskConfig(500, math.inf),
    train_horizon=TRAIN_HORIZON_STEPS,
    conditions=("near", "oriented", "hold_ok", *AT_REST),
    arm_conditions=("hold_ok", "ee_rest", "robot_rest"),
    label_rules=LABEL_RULES,
    published=PUBLISHED,
    events=(*PUBLISHED.events, "lost_navigated_close", "lost_success"),
    reward=REWARD,
    start="mjhab.episodes.starts.navigate:START",
    expert="mjhab.experts.skills.navigate:navigate",
)
