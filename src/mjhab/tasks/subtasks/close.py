"""The subtask Close: close a drawer or door and bring the hand back to rest.

MS-HAB paper App. A.2; mshab/envs/close.py.
"""

from __future__ import annotations

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
from mjhab.tasks.subtasks.jointed import JointNames, jointed_subtask
from mjhab.tasks.thresholds import TaskConfig

CLOSE_TERMS = (
    Term("reach", 7.0, "reaching", "hand to the handle: 1 - tanh(d)"),
    Term("grasp", 7.5, "gripping", "the handle is grasped, in place of reach"),
    Term(
        "closed",
        8.0,
        "closed",
        "closed with the hand at the handle, in place of reach and grasp",
    ),
    Term(
        "progress",
        5.0,
        ALWAYS,
        "share of the way from fully open to the opening that counts as closed",
    ),
    Term(
        "gentle",
        5.0,
        "gentle",
        "the joint moves at 2 rad/s (door), 1 m/s (drawer) or less",
    ),
    Term(
        "posture",
        1.0,
        "away",
        "torso, head and arm to rest: 1 - (tanh e + tanh(e / 5)) / 2, e = |q - rest|",
    ),
    Term("posture_closed", 10.0, "closed", "as posture"),
    Term("torso_up", 1.0, "closed", "height of the torso as a share of its travel"),
    Term("rest", 2.0, "closed", "hand to its rest point: 1 - (tanh d + tanh(3 d)) / 2"),
    Term("still", 2.0, "resting", "joint speeds: 1 - tanh(|qd|)"),
    Term("success", 3.0, "success", "the subtask is achieved"),
)

_CLOSE_SHARPNESS = {
    "reach": 1.0,
    "posture": 1.0,
    "posture_far": 0.2,
    "rest": 1.0,
    "rest_near": 3.0,
    "still": 1.0,
}


def _close(
    view: RewardView, config: TaskConfig, published: bool = False
) -> tuple[dict[str, Array], dict[str, Array]]:
    world = view.world
    signals = view.signals
    posture = posture_error(world, config)
    rest = rest_distance(world, config)
    distances = {
        "reach": view.handle_distance,
        "posture": posture,
        "posture_far": posture,
        "rest": rest,
        "rest_near": rest,
        "still": joint_speed(world, config),
    }
    raw = near(_CLOSE_SHARPNESS, distances)
    # Two slopes, as in mshab/envs/close.py: one that is felt far away and one that is steep near rest.
    raw["posture"] = raw["posture_closed"] = (raw["posture"] + raw["posture_far"]) / 2
    raw["rest"] = (raw["rest"] + raw["rest_near"]) / 2
    span = world.joint_max - world.joint_min
    # Counted from fully open, wherever the episode began.
    travel = (1 - config.close_fraction) * span
    raw["progress"] = 1 - share_left(
        travel - (world.joint_max - world.joint_q), travel, bounded=not published
    )
    raw["torso_up"] = view.torso_up
    closed = view.closed_near
    grasped = signals.is_grasped
    when = {
        "reaching": ~(closed | grasped),
        "gripping": grasped & ~closed,
        "closed": closed,
        "away": ~closed,
        "gentle": namespace(span).abs(view.joint_qd) <= view.joint_ideal,
        "resting": closed & signals.ee_rest & signals.robot_rest,
        "success": closed & signals.success,
    }
    return when, raw


REWARD = RewardTable(
    CLOSE_TERMS,
    cases=(
        ("gentle", "away", "reaching"),
        ("gentle", "away", "gripping"),
        ("gentle", "closed", "resting", "success"),
    ),
    published=37.0,
    raw=_close,
    reads=("joint",),
    raw_published=partial(_close, published=True),
)

NAMES = JointNames(
    there="closed",
    back="opened",
    slightly="slightly_closed",
    done="closed_success",
    undone="open_after_closing_failure",
    slight="slightly_closed_failure",
    unmoved="cant_close_failure",
)

CLOSE = jointed_subtask(
    NAMES,
    REWARD,
    name="close",
    words=("close {link}", "push {link} shut"),
    color="#14b8a6",
    shows=("goal",),
    start="mjhab.episodes.starts.close:START",
    expert="mjhab.experts.skills.articulated:close_link",
)
