"""The subtask Place: put a held object at its goal and bring the hand back to rest.

MS-HAB paper App. A.2; mshab/envs/place.py.
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
    above_zero,
    force_excess,
    joint_speed,
    lengths,
    near,
    posture_error,
    rest_distance,
    torso_speed,
)
from mjhab.tasks.subtasks.event_lists import EXCESS, last
from mjhab.tasks.subtasks.spec import AT_REST, LabelRule, PublishedLabels, SubtaskSpec
from mjhab.tasks.thresholds import SubtaskConfig, TaskConfig

GOAL_RISE = 0.05
"""Height above the goal [m] at which the term "height" rewards hand and object."""

PLACE_TERMS = (
    Term("slow_hand", 1.0, ALWAYS, "hand speed: 1 - tanh(v / 5)"),
    Term(
        "slow_object",
        3.0,
        ALWAYS,
        "object not thrown: 1 - tanh((|v| + |w|) / 5), 1 while it is grasped",
    ),
    Term(
        "force",
        3.0,
        ALWAYS,
        "contact force over 200 N: 1 - tanh(3 (max(0.001 F, 0.2) - 0.2))",
    ),
    Term("force_limit", 2.0, "force_ok", "the force so far is within the limit"),
    Term("success", 6.0, "success", "the subtask is achieved"),
    Term("grasp", 2.0, "carrying", "the object is grasped and not at its goal"),
    Term("torso_not_sinking", 1.0, "away", "downward torso speed: 1 - tanh(5 v)"),
    Term(
        "transport",
        6.0,
        "away",
        "object and hand to the goal: 1 - (tanh d_object + tanh d_hand) / 2",
    ),
    Term(
        "height",
        4.0,
        "away",
        "both 5 cm above the goal's height: 1 - tanh((dz_object + dz_hand) / 2)",
    ),
    Term("placed", 13.0, "placed", "the object is at its goal"),
    Term("rest", 5.0, "placed", "hand to its rest point: 1 - tanh(3 d)"),
    Term("posture", 4.0, "placed", "torso, head and arm to rest: 1 - tanh(|q - rest|)"),
    Term("torso_up", 2.0, "placed", "height of the torso as a share of its travel"),
    Term("base_still", 1.0, "placed", "base speed: 1 - tanh(v)"),
    Term("at_rest", 2.0, "resting", "placed, hand and joints at rest"),
    Term("still", 1.0, "resting", "joint speeds: 1 - tanh(|qd|)"),
    Term("base_still_resting", 1.0, "resting", "as base_still"),
)

_PLACE_SHARPNESS = {
    "slow_hand": 0.2,
    "slow_object": 0.2,
    "force": 3.0,
    "torso_not_sinking": 5.0,
    "transport": 1.0,
    "hand": 1.0,
    "height": 0.5,
    "rest": 3.0,
    "posture": 1.0,
    "base_still": 1.0,
    "still": 1.0,
}


def _place(
    view: RewardView, config: TaskConfig
) -> tuple[dict[str, Array], dict[str, Array]]:
    world = view.world
    signals = view.signals
    xp = namespace(world.tcp_pos)
    from_goal = view.object_pos - view.goal_pos
    hand = world.tcp_pos - view.goal_pos
    linear, angular, object_way, hand_way, hand_speed, base_speed = lengths(
        view.object_vel[:, :3],
        view.object_vel[:, 3:],
        from_goal,
        hand,
        view.tcp_vel,
        world.robot_qd[:, BASE],
    )
    distances = {
        "slow_hand": hand_speed,
        # An object in the hand moves with it, and must not be slowed down for that.
        "slow_object": xp.where(signals.is_grasped, 0.0, linear + angular),
        "force": force_excess(signals.robot_force, HAND_FORCE_PER_NEWTON),
        # Downwards alone: raising the torso brings the hand over the goal.
        "torso_not_sinking": above_zero(-torso_speed(world, config)),
        "transport": object_way,
        "hand": hand_way,
        "height": xp.abs(from_goal[:, 2] - GOAL_RISE) + xp.abs(hand[:, 2] - GOAL_RISE),
        "rest": rest_distance(world, config),
        "posture": posture_error(world, config),
        "base_still": base_speed,
        "still": joint_speed(world, config),
    }
    raw = near(_PLACE_SHARPNESS, distances)
    raw["transport"] = (raw["transport"] + raw["hand"]) / 2
    raw["torso_up"] = view.torso_up
    raw["base_still_resting"] = raw["base_still"]
    placed = signals.at_goal
    when = {
        "force_ok": signals.force_ok,
        "success": signals.success,
        "away": ~placed,
        "carrying": ~placed & signals.is_grasped,
        "placed": placed,
        "resting": placed & signals.ee_rest & signals.robot_rest,
    }
    return when, raw


REWARD = RewardTable(
    PLACE_TERMS,
    cases=(
        ("force_ok", "away", "carrying"),
        ("force_ok", "placed", "resting", "success"),
    ),
    published=44.0,
    raw=_place,
    reads=("object_vel",),
)

LABEL_RULES = (
    LabelRule(
        "success_then_excessive_collisions",
        lambda s: s.ever("success") & s.ever("excess"),
    ),
    LabelRule("dubious_success", lambda s: s.ever("success") & ~s.holds("at_goal")),
    LabelRule("winding_success", lambda s: s.ever("success") & s.ever("left_goal")),
    LabelRule(
        "dropped_to_goal_success", lambda s: s.ever("success") & ~s.first_success_release
    ),
    LabelRule("placed_in_goal_success", lambda s: s.ever("success")),
    LabelRule("excessive_collision_failure", lambda s: s.ever("excess")),
    LabelRule("didnt_grasp_failure", lambda s: ~s.ever("is_grasped")),
    LabelRule("didnt_reach_goal_failure", lambda s: ~s.ever("at_goal")),
    LabelRule("wont_let_go_failure", lambda s: s.holds("is_grasped")),
    LabelRule("too_slow_failure", lambda s: s.holds("at_goal")),
    LabelRule("place_in_goal_failure", lambda s: s.release_at_goal),
    # What is left: it was at its goal, was released elsewhere, and is not there.
    LabelRule("drop_to_goal_failure"),
)


def _published_label(events: Sequence[str], success: bool, at_goal_first: bool) -> str:
    """The rules for Place of mshab/utils/label_dataset.py."""
    label = _place_success if success else _place_failure
    return label(events, at_goal_first)


def _place_success(events: Sequence[str], at_goal_first: bool) -> str:
    if EXCESS in events:
        return "success_then_excessive_collisions"
    if last(events, "at_goal") < last(events, "left_goal"):
        return "dubious_success"
    # An object that is at its goal from the first action on has no event for it.
    if len(events) <= 4 and ("released_at_goal" in events or at_goal_first):
        return "placed_in_goal_success"
    if len(events) <= 4 and ("released_outside_goal" in events or not at_goal_first):
        return "dropped_to_goal_success"
    return "winding_success"


def _place_failure(events: Sequence[str], at_goal_first: bool) -> str:
    if EXCESS in events:
        return "excessive_collision_failure"
    if not events:
        return "didnt_grasp_failure"
    if "at_goal" not in events:
        return "didnt_reach_goal_failure"
    grasp = last(events, "grasped")
    inside = last(events, "released_at_goal")
    outside = last(events, "released_outside_goal")
    placed = (len(events) <= 2 and at_goal_first) or (inside > outside and inside > grasp)
    dropped = (len(events) <= 2 and not at_goal_first) or (
        outside > inside and outside > grasp
    )
    left = last(events, "left_goal") > last(events, "at_goal")
    if placed and left:
        return "place_in_goal_failure"
    if dropped and left:
        return "drop_to_goal_failure"
    return "wont_let_go_failure" if grasp > max(inside, outside) else "too_slow_failure"


PUBLISHED = PublishedLabels(
    events=(
        "grasped",
        "at_goal",
        "released_at_goal",
        "released_outside_goal",
        "left_goal",
        "success",
        EXCESS,
    ),
    label=_published_label,
    columns=(
        "placed_in_goal_success",
        "dropped_to_goal_success",
        "dubious_success",
        "winding_success",
        "success_then_excessive_collisions",
        "excessive_collision_failure",
        "didnt_grasp_failure",
        "didnt_reach_goal_failure",
        "place_in_goal_failure",
        "drop_to_goal_failure",
        "wont_let_go_failure",
        "too_slow_failure",
    ),
)

PLACE = SubtaskSpec(
    name="place",
    words=("put {object} {goal}", "place {object} {goal}", "set {object} down {goal}"),
    color="#8b5cf6",
    about="object",
    limits=SubtaskConfig(200, 7500.0),
    conditions=("let_go", "at_goal", *AT_REST),
    label_rules=LABEL_RULES,
    published=PUBLISHED,
    events=(*PUBLISHED.events, "lost_success"),
    reward=REWARD,
    starts_holding=True,
    # In a chain the object has to stay while later subtasks are done.
    keeps_goal=True,
    start="mjhab.episodes.starts.place:START",
    expert="mjhab.experts.skills.place_by_rule:place",
)
