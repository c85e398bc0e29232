"""The subtask Pick: grasp an object and bring the hand back to rest.

MS-HAB paper App. A.2; mshab/envs/pick.py.
"""

from __future__ import annotations

from collections.abc import Sequence

from mjhab.core.arrays import Array, namespace
from mjhab.core.joints import BASE
from mjhab.tasks.rewards.table import (
    ALWAYS,
    HAND_FORCE_PER_NEWTON,
    RewardTable,
    RewardView,
    Term,
    force_excess,
    joint_speed,
    lengths,
    near,
    posture_error,
    rest_distance,
    torso_speed,
)
from mjhab.tasks.subtasks.event_lists import EXCESS
from mjhab.tasks.subtasks.spec import AT_REST, LabelRule, PublishedLabels, SubtaskSpec
from mjhab.tasks.thresholds import SubtaskConfig, TaskConfig

TORSO_FREE_RANGE = 0.3
"""Distance of the tcp to the object [m] below which motions of the torso are not penalised."""

PICK_TERMS = (
    Term("reach", 5.0, ALWAYS, "hand to the object: 1 - tanh(3 d)"),
    Term("slow_hand", 1.0, ALWAYS, "hand speed: 1 - tanh(v / 5)"),
    Term("posture", 1.0, ALWAYS, "torso, head and arm to rest: 1 - tanh(|q - rest| / 5)"),
    Term(
        "force",
        3.0,
        ALWAYS,
        "contact force over 200 N: 1 - tanh(3 (max(0.001 F, 0.2) - 0.2))",
    ),
    Term("force_limit", 2.0, "force_ok", "the force so far is within the limit"),
    Term("grasp", 2.0, "grasped", "the object is grasped"),
    Term("success", 3.0, "success", "the subtask is achieved"),
    Term(
        "torso_still",
        1.0,
        "reaching",
        "torso speed: 1 - tanh(5 v), 1 within 0.3 m of the object",
    ),
    Term(
        "above", 1.0, "reaching", "hand over the object: 1 - tanh(5 d), d along the floor"
    ),
    Term("hold", 2.0, "grasped", "the object is held, the way back to rest begins"),
    Term("rest", 5.0, "grasped", "hand to its rest point: 1 - tanh(3 d)"),
    Term("posture_holding", 1.0, "grasped", "as posture"),
    Term("base_still", 1.0, "grasped", "base speed: 1 - tanh(v)"),
    Term("at_rest", 2.0, "resting", "held, hand and joints at rest"),
    Term("still", 1.0, "resting", "joint speeds: 1 - tanh(|qd|)"),
)

_PICK_SHARPNESS = {
    "reach": 3.0,
    "slow_hand": 0.2,
    "posture": 0.2,
    "force": 3.0,
    "torso_still": 5.0,
    "above": 5.0,
    "rest": 3.0,
    "base_still": 1.0,
    "still": 1.0,
}


def _pick(
    view: RewardView, config: TaskConfig
) -> tuple[dict[str, Array], dict[str, Array]]:
    world = view.world
    signals = view.signals
    xp = namespace(world.tcp_pos)
    delta = world.tcp_pos - view.object_pos
    distance, hand_speed, base_speed = lengths(
        delta, view.tcp_vel, world.robot_qd[:, BASE]
    )
    x = delta[:, 0]
    y = delta[:, 1]
    distances = {
        "reach": distance,
        "slow_hand": hand_speed,
        "posture": posture_error(world, config),
        "force": force_excess(signals.robot_force, HAND_FORCE_PER_NEWTON),
        "torso_still": xp.where(
            # Near the object the torso may have to move to reach it.
            distance < TORSO_FREE_RANGE,
            0.0,
            xp.abs(torso_speed(world, config)),
        ),
        "above": xp.sqrt(x * x + y * y),
        "rest": rest_distance(world, config),
        "base_still": base_speed,
        "still": joint_speed(world, config),
    }
    raw = near(_PICK_SHARPNESS, distances)
    raw["posture_holding"] = raw["posture"]
    grasped = signals.is_grasped
    when = {
        "force_ok": signals.force_ok,
        "success": signals.success,
        "reaching": ~grasped,
        "grasped": grasped,
        "resting": grasped & signals.ee_rest & signals.robot_rest,
    }
    return when, raw


REWARD = RewardTable(
    PICK_TERMS,
    cases=(("force_ok", "reaching"), ("force_ok", "grasped", "resting", "success")),
    published=28.0,
    raw=_pick,
)

LABEL_RULES = (
    LabelRule(
        "success_then_excessive_collisions",
        lambda s: s.ever("success") & s.ever("excess"),
    ),
    LabelRule("success_then_drop", lambda s: s.ever("success") & ~s.holds("is_grasped")),
    LabelRule("winding_success", lambda s: s.ever("success") & s.ever("released")),
    LabelRule("straightforward_success", lambda s: s.ever("success")),
    LabelRule("excessive_collision_failure", lambda s: s.ever("excess")),
    LabelRule(
        "mobility_failure", lambda s: ~s.ever("is_grasped") & ~s.ever("ee_contact")
    ),
    LabelRule("cant_grasp_failure", lambda s: ~s.ever("is_grasped")),
    LabelRule("drop_failure", lambda s: ~s.holds("is_grasped")),
    # What is left: the object is held, and the hand is not back at rest.
    LabelRule("too_slow_failure"),
)


def _published_label(events: Sequence[str], success: bool, at_goal_first: bool) -> str:
    """The rule for Pick of mshab/utils/label_dataset.py."""
    if success:
        # Contact, grasp, success and nothing else: each once, in this order.
        if len(events) == 3:
            return "straightforward_success"
        if len(events) > 3 and events[-1] == "success":
            return "winding_success"
        if len(events) > 3 and EXCESS not in events:
            return "success_then_drop"
        return "success_then_excessive_collisions"
    if EXCESS in events:
        return "excessive_collision_failure"
    if not events:
        return "mobility_failure"
    if len(events) == 1:
        return "cant_grasp_failure"
    return (
        "drop_failure"
        if "dropped" in events and events[-1] != "grasped"
        else "too_slow_failure"
    )


PUBLISHED = PublishedLabels(
    events=("contact", "grasped", "dropped", "success", EXCESS),
    label=_published_label,
    columns=(
        "straightforward_success",
        "winding_success",
        "success_then_drop",
        "success_then_excessive_collisions",
        "excessive_collision_failure",
        "mobility_failure",
        "cant_grasp_failure",
        "drop_failure",
        "too_slow_failure",
    ),
)

PICK = SubtaskSpec(
    name="pick",
    words=(
        "pick up {object} {source}",
        "take {object} {source}",
        "grab {object} {source}",
    ),
    color="#3b82f6",
    about="object",
    limits=SubtaskConfig(200, 5000.0),
    conditions=("is_grasped", *AT_REST),
    label_rules=LABEL_RULES,
    published=PUBLISHED,
    events=(*PUBLISHED.events, "lost_contact", "lost_success"),
    reward=REWARD,
    shows=("object",),
    # With an object in the hand the original allows 0.6 in place of 0.2 rad from rest.
    rests_holding=True,
    start="mjhab.episodes.starts.pick:START",
    expert="mjhab.experts.skills.pick_by_rule:pick",
)
