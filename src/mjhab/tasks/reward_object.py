"""Dense rewards of Pick and Place (mshab/envs/pick.py, mshab/envs/place.py)."""

from __future__ import annotations

from mjhab.core.arrays import Array, namespace
from mjhab.core.joints import BASE
from mjhab.tasks.plan import SubtaskKind, TaskConfig
from mjhab.tasks.reward_table import (
    ALWAYS,
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

FORCE_PER_NEWTON = 0.001
"""Contact forces below 200 N cost nothing."""
TORSO_FREE_RANGE = 0.3
"""Pick: this close to the object [m] the torso may move."""
GOAL_RISE = 0.05
"""Place: hand and object come in at this height above the goal [m]."""

PICK_TERMS = (
    Term("reach", 5.0, ALWAYS, "hand to the object: 1 - tanh(3 d)"),
    Term("slow_hand", 1.0, ALWAYS, "hand speed: 1 - tanh(v / 5)"),
    Term("posture", 1.0, ALWAYS, "torso, head and arm to rest: 1 - tanh(|q - rest| / 5)"),
    Term("force", 3.0, ALWAYS, "contact force over 200 N: 1 - tanh(3 (max(0.001 F, 0.2) - 0.2))"),
    Term("force_limit", 2.0, "force_ok", "the force so far is within the limit"),
    Term("grasp", 2.0, "grasped", "the object is grasped"),
    Term("success", 3.0, "success", "the subtask is achieved"),
    Term(
        "torso_still", 1.0, "reaching", "torso speed: 1 - tanh(5 v), 1 within 0.3 m of the object"
    ),
    Term("above", 1.0, "reaching", "hand over the object: 1 - tanh(5 d), d along the floor"),
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


def _pick(view: RewardView, config: TaskConfig) -> tuple[dict[str, Array], dict[str, Array]]:
    world = view.world
    signals = view.signals
    xp = namespace(world.tcp_pos)
    delta = world.tcp_pos - view.object_pos
    distance, hand_speed, base_speed = lengths(delta, view.tcp_vel, world.robot_qd[:, BASE])
    x = delta[:, 0]
    y = delta[:, 1]
    distances = {
        "reach": distance,
        "slow_hand": hand_speed,
        "posture": posture_error(world, config),
        "force": force_excess(signals.robot_force, FORCE_PER_NEWTON),
        "torso_still": xp.where(
            distance < TORSO_FREE_RANGE, 0.0, xp.abs(torso_speed(world, config))
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


PICK = RewardTable(
    SubtaskKind.PICK,
    PICK_TERMS,
    cases=(("force_ok", "reaching"), ("force_ok", "grasped", "resting", "success")),
    published=28.0,
    raw=_pick,
)

PLACE_TERMS = (
    Term("slow_hand", 1.0, ALWAYS, "hand speed: 1 - tanh(v / 5)"),
    Term(
        "slow_object",
        3.0,
        ALWAYS,
        "object not thrown: 1 - tanh((|v| + |w|) / 5), 1 while it is grasped",
    ),
    Term("force", 3.0, ALWAYS, "contact force over 200 N: 1 - tanh(3 (max(0.001 F, 0.2) - 0.2))"),
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


def _place(view: RewardView, config: TaskConfig) -> tuple[dict[str, Array], dict[str, Array]]:
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
        "slow_object": xp.where(signals.is_grasped, 0.0, linear + angular),
        "force": force_excess(signals.robot_force, FORCE_PER_NEWTON),
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


PLACE = RewardTable(
    SubtaskKind.PLACE,
    PLACE_TERMS,
    cases=(("force_ok", "away", "carrying"), ("force_ok", "placed", "resting", "success")),
    published=44.0,
    raw=_place,
)
