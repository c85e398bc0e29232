"""Dense rewards of Open and Close (mshab/envs/open.py, mshab/envs/close.py)."""

from __future__ import annotations

from functools import partial

from mjhab.core.arrays import Array, namespace
from mjhab.tasks.plan import SubtaskKind, TaskConfig
from mjhab.tasks.reward_table import (
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

IDEAL_SPEED = {"hinge": 2.0, "slide": 1.0}
"""A door should turn no faster [rad/s] and a drawer slide no faster [m/s] than this, by type of joint."""
STARTED = 0.01
"""Open: the joint has left its closed end by so much [m or rad]."""
CLOSED_NEAR = 0.3
"""Close: the link counts as closed by the hand when the handle is this close to it [m]."""

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


OPEN = RewardTable(
    SubtaskKind.OPEN,
    OPEN_TERMS,
    cases=(
        ("gentle", "started", "reaching"),
        ("gentle", "started", "gripping"),
        ("gentle", "started", "opened", "resting", "success"),
    ),
    published=27.0,
    raw=_open,
    raw_published=partial(_open, published=True),
)

CLOSE_TERMS = (
    Term("reach", 7.0, "reaching", "hand to the handle: 1 - tanh(d)"),
    Term("grasp", 7.5, "gripping", "the handle is grasped, in place of reach"),
    Term(
        "closed", 8.0, "closed", "closed with the hand at the handle, in place of reach and grasp"
    ),
    Term(
        "progress",
        5.0,
        ALWAYS,
        "share of the way from fully open to the opening that counts as closed",
    ),
    Term("gentle", 5.0, "gentle", "the joint moves at 2 rad/s (door), 1 m/s (drawer) or less"),
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
    raw["posture"] = raw["posture_closed"] = (raw["posture"] + raw["posture_far"]) / 2
    raw["rest"] = (raw["rest"] + raw["rest_near"]) / 2
    span = world.joint_max - world.joint_min
    way = (1 - config.close_fraction) * span
    raw["progress"] = 1 - share_left(
        way - (world.joint_max - world.joint_q), way, bounded=not published
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


def closed_near(before: Array, closed: Array, distance: Array) -> Array:
    """Whether the link is closed and the hand has been at the handle since it was: (W,) bool.

    Args:
        before: (W,) bool, the value one control step earlier; False at the start of a subtask.
        closed: (W,) bool, the link is closed now; a link that opens again loses the credit.
        distance: (W,) from the hand to the handle [m].
    """
    return closed & (before | (distance <= CLOSED_NEAR))


CLOSE = RewardTable(
    SubtaskKind.CLOSE,
    CLOSE_TERMS,
    cases=(
        ("gentle", "away", "reaching"),
        ("gentle", "away", "gripping"),
        ("gentle", "closed", "resting", "success"),
    ),
    published=37.0,
    raw=_close,
    raw_published=partial(_close, published=True),
)
