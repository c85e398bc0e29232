"""What Push is: success, labels, events and dense reward."""

from __future__ import annotations

from mjhab.core.arrays import Array, namespace, norm3, pick_column
from mjhab.tasks.rewards.table import (
    ALWAYS,
    RewardTable,
    RewardView,
    Term,
    force_excess,
    near,
    rest_distance,
)
from mjhab.tasks.signals import Active, WorldState
from mjhab.tasks.subtasks.spec import AT_REST, LabelRule, SubtaskSpec
from mjhab.tasks.thresholds import SubtaskConfig, TaskConfig

from .expert import push
from .start import PushStart

ZONE_RADIUS_M = 0.08
ZONE_HEIGHT_M = 0.05
"""The centre of the object must be so near to the goal along the table, and so near to its height."""
FORCE_PER_NEWTON = 0.001
"""Contact forces below 200 N cost nothing."""


def in_zone(state: WorldState, active: Active, config: TaskConfig) -> Array:
    """(W,) bool: the object is in its zone, and still on the table."""
    delta = pick_column(state.plan_obj_pos, active.index) - active.goal_pos
    xp = namespace(delta)
    flat = xp.sqrt(delta[:, 0] * delta[:, 0] + delta[:, 1] * delta[:, 1])
    return (flat <= ZONE_RADIUS_M) & (xp.abs(delta[:, 2]) <= ZONE_HEIGHT_M)


TERMS = (
    Term("reach", 3.0, "away", "hand to the object: 1 - tanh(3 d)"),
    Term("push", 8.0, "away", "object to its goal: 1 - tanh(5 d)"),
    Term(
        "in_zone",
        12.0,
        "in_zone",
        "the object is in its zone, in place of reach and push",
    ),
    Term("rest", 4.0, "in_zone", "hand to its rest point: 1 - tanh(3 d)"),
    Term(
        "force",
        2.0,
        ALWAYS,
        "contact force over 200 N: 1 - tanh(3 (max(0.001 F, 0.2) - 0.2))",
    ),
    Term("success", 4.0, "success", "the subtask is achieved"),
)
_SHARPNESS = {"reach": 3.0, "push": 5.0, "rest": 3.0, "force": 3.0}


def raw_rewards(
    view: RewardView, config: TaskConfig
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Conditions and raw values of the terms, (W,) each."""
    distances = {
        "reach": norm3(view.world.tcp_pos - view.object_pos),
        "push": norm3(view.object_pos - view.goal_pos),
        "rest": rest_distance(view.world, config),
        "force": force_excess(view.signals.robot_force, FORCE_PER_NEWTON),
    }
    when = {
        "away": ~view.signals.at_goal,
        "in_zone": view.signals.at_goal,
        "success": view.signals.success,
    }
    return when, near(_SHARPNESS, distances)


PUSH = SubtaskSpec(
    name="push",
    words=("push {object} {goal}", "slide {object} {goal}"),
    color="#ec4899",
    about="object",
    limits=SubtaskConfig(horizon=250, force_limit=7500.0),
    conditions=("at_goal", "let_go", *AT_REST),
    measures={"at_goal": in_zone},
    label_rules=(
        LabelRule(
            "success_then_excessive_collisions",
            lambda s: s.ever("success") & s.ever("excess"),
        ),
        LabelRule(
            "success_then_left_zone", lambda s: s.ever("success") & ~s.holds("at_goal")
        ),
        LabelRule("push_success", lambda s: s.ever("success")),
        LabelRule("excessive_collision_failure", lambda s: s.ever("excess")),
        LabelRule("didnt_touch_failure", lambda s: ~s.ever("ee_contact")),
        LabelRule(
            "left_zone_failure", lambda s: s.ever("left_goal") & ~s.holds("at_goal")
        ),
        LabelRule("too_slow_failure", lambda s: s.holds("at_goal")),
        LabelRule("short_of_zone_failure"),
    ),
    events=(
        "touched",
        "entered_zone",
        "left_zone",
        "success",
        "lost_success",
        "excessive_collisions",
    ),
    edges={"touched": "+ee_contact", "entered_zone": "+at_goal", "left_zone": "-at_goal"},
    reward=RewardTable(TERMS, cases=(("away",), ("in_zone", "success")), raw=raw_rewards),
    start=PushStart(),
    expert=push,
)
