"""The subtask Open: open a drawer or door and bring the hand back to rest.

MS-HAB paper App. A.2; mshab/envs/open.py.
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

STARTED = 0.01
"""Opening [m or rad] above which the joint has left its closed end."""

OPEN_TERMS = (
    Term("reach", 3.0, "reaching", "hand to the handle: 1 - tanh(d)"),
    Term("grasp", 5.0, "gripping", "the handle is grasped, in place of reach"),
    Term("opened", 6.0, "opened", "the link is open, in place of reach and grasp"),
    Term(
        "progress",
        6.0,
        ALWAYS,
        "share of the way from closed to the opening that counts as open",
    ),
    Term("started", 3.0, "started", "the joint has left its closed end by 0.01"),
    Term(
        "gentle",
        3.0,
        "gentle",
        "the joint moves at 2 rad/s (door), 1 m/s (drawer) or less",
    ),
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
    travel = view.open_frac * (world.joint_max - world.joint_min)
    opening = world.joint_q - world.joint_min
    raw["progress"] = 1 - share_left(travel - opening, travel, bounded=not published)
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

NAMES = JointNames(
    there="opened",
    back="closed",
    slightly="slightly_opened",
    done="open_success",
    undone="closed_after_open_failure",
    slight="slightly_open_failure",
    unmoved="cant_open_failure",
)

OPEN = jointed_subtask(
    NAMES,
    REWARD,
    name="open",
    words=("open {link}", "pull {link} open"),
    color="#f59e0b",
    shows=("object", "goal"),
    start="mjhab.episodes.starts.open:START",
    expert="mjhab.experts.skills.articulated:open_link",
)
