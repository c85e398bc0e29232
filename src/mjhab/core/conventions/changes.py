"""The conversions between the conventions of `names`; there are no others. They take numpy or torch arrays."""

from __future__ import annotations

import math
from functools import cache

from mjhab.core.arrays import Array, as_like, cast, constant, namespace
from mjhab.core.conventions.names import SCAN_AXES
from mjhab.core.rotations import quat_canonical, quat_from_yaw, quat_mul

_TURN = 2 * math.pi


def to_scan_axes(poses: Array, scan_yaw: Array | float) -> Array:
    """Poses in the axes of the scans, for poses in mjhab's frames of the objects.

    The axes of a scan are turned about z by its heading: q becomes q * (cos yaw/2, 0, 0, sin yaw/2).

    Args:
        poses: (..., 7) position [m] and quaternion wxyz, numpy or torch; a quaternion of zeros stays one.
        scan_yaw: (...) or one number, `scenes.spec.ObjectType.scan_yaw` [rad] of the objects.

    Returns:
        New array of the same shape and type; quaternions have w >= 0.
    """
    xp = namespace(poses)
    # In double precision, so that every library rounds to the same float32.
    quats = cast(poses[..., 3:], xp.float64)
    yaw = xp.broadcast_to(as_like(scan_yaw, quats), quats.shape[:-1])
    turned = quat_canonical(quat_mul(quats, quat_from_yaw(yaw)))
    # What is not turned keeps its bits.
    chosen = xp.where((yaw != 0.0)[..., None], cast(turned, poses.dtype), poses[..., 3:])
    return xp.concat([poses[..., :3], chosen], axis=-1)


def from_scan_axes(poses: Array, scan_yaw: Array | float) -> Array:
    """Inverse of `to_scan_axes`."""
    return to_scan_axes(poses, -scan_yaw)


def change_axes(poses: Array, scan_yaw: Array | float, have: str, want: str) -> Array:
    """Poses (..., 7) in the axes ``want`` of AXES, for poses in the axes ``have``; the same array if they are equal."""
    if have == want:
        return poses
    change = to_scan_axes if want == SCAN_AXES else from_scan_axes
    return change(poses, scan_yaw)


def within_half_a_turn(angles: Array, endless: tuple[bool, ...]) -> Array:
    """Angles of joints without limits, shifted by whole turns to [-pi, pi]; what lies there keeps its value.

    Args:
        angles: (..., J) joint positions or their differences [m, rad], numpy or torch.
        endless: for each of the J whether it is the angle of a joint without limits.
    """
    return nearest_turn(angles, 0.0, endless)


def nearest_turn(
    angles: Array, reference: Array | float, endless: tuple[bool, ...]
) -> Array:
    """Angles of joints without limits, shifted by whole turns to within half a turn of ``reference``.

    Args:
        angles: (..., J) joint positions [m, rad], numpy or torch.
        reference: (..., J), or one number.
        endless: for each of the J whether it is the angle of a joint without limits.
    """
    if not any(endless):
        return angles
    per_turn = constant(turns(endless), angles)
    # Rounding gives 0 turns within half a turn, so that what lies there keeps its bits.
    return angles - _TURN * namespace(angles).round((angles - reference) * per_turn)


@cache
def turns(endless: tuple[bool, ...]) -> tuple[float, ...]:
    """Turns per radian of joints without limits, 0 for others."""
    return tuple(1.0 / _TURN if free else 0.0 for free in endless)
