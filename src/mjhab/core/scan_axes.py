"""Poses of objects in the axes of their scans, as MS-HAB's observations give them.

mjhab turns the frame of a boxy object about its z axis until its sides lie along the axes; the heading of the scan's
axes in that frame is `scenes.spec.ObjectType.scan_yaw`. See docs/assets.md, "Headings of scanned boxes".
"""

from __future__ import annotations

import numpy as np

from mjhab.core.rotations import quat_canonical, quat_from_yaw, quat_mul

OBJECT_POSE = "extra/obj_pose_wrt_base"
"""The observation that these functions convert: position [m], quaternion with w >= 0; zeros without an object."""


def to_scan_axes(poses: np.ndarray, scan_yaw: np.ndarray | float) -> np.ndarray:
    """Poses in the axes of the scans, for poses in mjhab's frames of the objects.

    Args:
        poses: (..., 7) position [m] and quaternion wxyz; a quaternion of zeros stays one.
        scan_yaw: (...) or one number, `ObjectType.scan_yaw` [rad] of the objects.

    Returns:
        New array of the same shape and type; quaternions have w >= 0.
    """
    yaw = np.broadcast_to(np.asarray(scan_yaw, np.float64), poses.shape[:-1])
    turned = poses.copy()
    # What is not turned keeps its bits.
    boxy = yaw != 0.0
    quats = quat_mul(poses[boxy][:, 3:].astype(np.float64), quat_from_yaw(yaw[boxy]))
    turned[boxy, 3:] = quat_canonical(quats)
    return turned


def from_scan_axes(poses: np.ndarray, scan_yaw: np.ndarray | float) -> np.ndarray:
    """Inverse of `to_scan_axes`."""
    return to_scan_axes(poses, -np.asarray(scan_yaw, np.float64))
