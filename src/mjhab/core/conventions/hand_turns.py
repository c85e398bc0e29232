"""Turns of the hand as ManiSkill 3 makes them of actions (mani_skill/agents/controllers/pd_ee_pose.py).

The last three numbers of its ``pd_ee_delta_pose`` are angles about the axes x, y, z, and the hand turns backwards: they
are scaled by the lower bound of the turn (its issue #1469). Ours are a rotation vector, as it documents.
"""

from __future__ import annotations

from mjhab.core.arrays import Array, constant, namespace
from mjhab.core.rotations import mat_from_rotation_vector

AS_MANISKILL = {
    "pd_ee_delta_pose": "pd_ee_delta_pose_maniskill",
    "pd_ee_target_delta_pose": "pd_ee_target_delta_pose_maniskill",
}
"""Control modes of ManiSkill whose turns are backwards, and our modes that turn as they do; those of the same name turn
as documented."""
TURN_COLUMNS = slice(3, 6)
"""The turn in an action of these modes."""
LARGEST_TURN_RAD = 0.1
"""Turn of an action of length 1."""


def maniskill_turn(angles: Array) -> Array:
    """The rotation (W, 3, 3) that ManiSkill's ``pd_ee_delta_pose`` makes of angles (W, 3) [rad], see `EndEffector`."""
    about_x, about_y, about_z = (
        mat_from_rotation_vector(angles * constant(axis, angles))
        for axis in ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
    )
    return about_x @ about_y @ about_z


def maniskill_angles(vectors: Array) -> Array:
    """Angles (W, 3) [rad] whose `maniskill_turn` is the rotation of vectors (W, 3) [rad] shorter than 90 degrees."""
    xp = namespace(vectors)
    rot = mat_from_rotation_vector(vectors)
    about_x = xp.arctan2(-rot[:, 1, 2], rot[:, 2, 2])
    # Rounding can leave an entry of a rotation matrix beyond 1, of which there is no arcsine.
    about_y = xp.arcsin(xp.clip(rot[:, 0, 2], -1.0, 1.0))
    about_z = xp.arctan2(-rot[:, 0, 1], rot[:, 0, 0])
    return -xp.stack([about_x, about_y, about_z], axis=1)


def turns_for_maniskill(actions: Array) -> Array:
    """Turns (T, 3) in [-1, 1] with which ManiSkill's mode turns the hand as our mode of the same name does with ours.

    Args:
        actions: (T, 3) turns; longer than 1 they are clipped by their length, as controllers do.
    """
    xp = namespace(actions)
    length = xp.sqrt(xp.sum(actions**2, axis=1, keepdims=True))
    # By the length and not by entry, which would change the axis of the turn.
    clipped = actions / xp.maximum(length, constant((1.0,), length))
    return maniskill_angles(LARGEST_TURN_RAD * clipped) / LARGEST_TURN_RAD
