"""Release of an object: its motion when it tips over, the opening of the fingers, the retreat of the hand.

Lengths [m], angles [rad], world frame.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

import numpy as np

from mjhab.core.rotations import mat_from_rotation_vector
from mjhab.envs.parts.world_view import WorldView
from mjhab.episodes.grasps.candidates import approach_clearance
from mjhab.episodes.grasps.stable import ObjectShape
from mjhab.experts.arm import ik, motion
from mjhab.experts.planning.workplace import surroundings

TIGHT_PLAY_M = 0.008
"""Fingers that can each open by less than this may touch the object while the hand retreats."""
JAMMED_PLAY_M = 0.002
"""Fingers that can each open by less than this stay in contact with the object while the hand retreats."""
AWAY_SPEED_M_S = 0.3
"""Speed of the hand while it retreats."""
TIGHT_AWAY_SPEED_M_S = 0.12
"""Speed of the hand while it retreats and the fingers may touch the object: at the start of a faster motion the hand
deviates from the straight line by millimetres."""
EXTRA_OPENINGS_M = (0.03, 0.045, 0.06)
"""Candidates for the increase of the finger opening on release; the largest with enough clearance is taken. The hand
opens 0.0985 m in all."""
DRAW_BACK_M = (0.04, 0.06, 0.08, 0.10, 0.12, 0.14)
"""Candidates for the distance of the retreat."""
DRAW_BACK_CLEARANCE_M = 0.01
"""Least clearance of hand and arm during the retreat."""
FREE_CLEARANCE_M = 0.025
"""Clearance between the hand and the released object from which on the arm may move in any direction."""


def tipped(shape: ObjectShape, rot: np.ndarray) -> np.ndarray:
    """Displacement (3,) [m] of an object's centre when it is released on a level surface and tips over.

    The object touches the surface with its lowest point and tips about it onto the face through which the line of
    gravity from its centre leaves it.

    Args:
        shape: shape of the object.
        rot: (3, 3) orientation at the release.
    """
    # It rolls and does not tip.
    if shape.kind == "sphere":
        return np.zeros(3)
    turn = rot
    half = np.array(shape.half)
    if shape.kind in ("cylinder", "bowl"):
        # Turn the frame about the symmetry axis so that the lowest point is in its x-z plane.
        yaw = np.arctan2(-rot[2, 1], -rot[2, 0])
        turn = rot @ mat_from_rotation_vector(np.array([[0.0, 0.0, yaw]]))[0]
    down = -turn[2]
    # Rounding would choose a side of an object that stands straight.
    down = np.where(np.abs(down) < 1e-9, 0.0, down)
    side = int(np.argmax(np.abs(down) / half))
    lowest = turn @ (np.sign(down) * half)
    normal = turn[:, side] * np.sign(down[side])
    # The tipping axis is the cross product of ``normal`` and the direction of gravity.
    axis = np.array([-normal[1], normal[0], 0.0])
    across = _cross(axis, lowest)
    return -(across + _cross(axis, across) / (1.0 - normal[2]))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross product of two vectors (3,), ten times as fast as numpy's for a single pair."""
    ax, ay, az = a.tolist()
    bx, by, bz = b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def play(view: WorldView) -> float:
    """Distance [m] by which each finger can still open."""
    robot = view.robot
    return robot.limits.gripper[1] - float(view.q[robot.columns.fingers].mean())


def away_speed(view: WorldView) -> float:
    """Speed [m/s] of the hand's retreat from the object that is still between the fingers."""
    return (
        TIGHT_AWAY_SPEED_M_S
        if JAMMED_PLAY_M < play(view) < TIGHT_PLAY_M
        else AWAY_SPEED_M_S
    )


def let_go_width(view: WorldView, obj: str, pos: np.ndarray, rot: np.ndarray) -> float:
    """Choose the distance [m] between the opened fingers for a release, from `EXTRA_OPENINGS_M` and the clearance.

    Args:
        view: the world.
        obj: name of the held object.
        pos: (3,) tcp position.
        rot: (3, 3) tcp rotation.
    """
    near = surroundings(view, obj, pos)[0].near(pos, 0.3)
    now = 2.0 * float(view.q[view.robot.columns.fingers].mean())
    widths = now + np.array([0.0, *EXTRA_OPENINGS_M])
    at = np.repeat(pos[None], len(widths), axis=0)
    turn = np.repeat(rot[None], len(widths), axis=0)
    clearance = approach_clearance(at, turn, widths, at, near, view.robot.gripper)
    return float(
        widths[1:][clearance[1:] > min(DRAW_BACK_CLEARANCE_M, clearance[0] - 0.004)].max(
            initial=widths[1]
        )
    )


def drawn_back(
    view: WorldView, obj: str, pos: np.ndarray, rot: np.ndarray, rest: np.ndarray
) -> np.ndarray:
    """Choose the tcp position (3,) to which the hand retreats after a release, before the arm moves to rest.

    The retreat goes along the hand's axis, else straight up, else towards the robot, without a component along the
    fingers' closing direction. It ends where the hand has `FREE_CLEARANCE_M` to the object, or as far as hand and arm
    keep `DRAW_BACK_CLEARANCE_M` to trunk and furniture.

    Args:
        view: the world.
        obj: name of the released object.
        pos: (3,) tcp position at the release.
        rot: (3, 3) tcp rotation at the release.
        rest: (J,) preferred posture of the inverse kinematics.
    """
    robot = view.robot.chain
    whole = motion.spheres(view.robot)
    hand_links = view.robot.hand_links
    hand = whole.only(hand_links)
    arm = whole.only([name for name in whole.chain.links if name not in hand_links])
    near, target = surroundings(view, obj, pos)
    heading = float(view.base[2])
    directions = np.array(
        [-rot[:, 0], [0.0, 0.0, 1.0], [-np.cos(heading), -np.sin(heading), 0.0]]
    )
    directions = directions - (directions @ rot[:, 1])[:, None] * rot[:, 1]
    # No candidate moves along the line of the fingers: that would drag the object along.
    spots = (pos + np.array(DRAW_BACK_M)[:, None] * directions[:, None]).reshape(-1, 3)
    turns = np.repeat(rot[None], len(spots), axis=0)
    found = ik.solve(
        robot,
        ik.TipGoals(spots, turns, ik.columns(robot, torso=False), rest),
        view.q[None],
    )
    q = np.concatenate([view.q[None], found.q[:, 0]])
    clearance = np.minimum(
        np.minimum(whole.self_clearance(q), arm.clearance(q, near)),
        hand.clearance(q, near),
    )
    gap = hand.clearance(q, target)
    fine = (
        found.ok[:, 0]
        & (clearance[1:] > min(DRAW_BACK_CLEARANCE_M, clearance[0] - 0.004))
        & (gap[1:] > gap[0] - 0.004)
    )
    # A spot counts only if all before it on the line are free.
    fine = np.logical_and.accumulate(fine.reshape(len(directions), -1), axis=1)
    free = fine & (gap[1:].reshape(fine.shape) > FREE_CLEARANCE_M)
    far = fine.sum(axis=1) - 1
    spots = spots.reshape(len(directions), -1, 3)
    if free.any():
        # The nearest spot that is far enough away.
        far = free.argmax(axis=1)
        chosen = int(free.any(axis=1).argmax())
    else:
        chosen = int(far.argmax())
    return spots[chosen, max(int(far[chosen]), 0)]
