"""Rotations and poses on arrays: quaternions wxyz (unit), poses as 7 numbers x, y, z, w, x, y, z.

Every function but `wrap` takes numpy or torch arrays, batches over the leading axes (which broadcast) and keeps the
dtype.
"""

from __future__ import annotations

import numpy as np

from mjhab.core.arrays import Array, Table, cast, constant, namespace, norm3

IDENTITY_MATRIX = Table(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
"""The rotation matrix (3, 3) that turns nothing."""

_LOCKED = 1e-7
"""Cosine of the second of three Euler angles under which the two others turn about one line."""
_SIGN_WEIGHTS = (8.0, 4.0, 2.0, 1.0)
"""Each is more than the sum of those behind it: the weighted sum of signs has the sign of the first that is not 0."""


def quat_canonical(q: Array) -> Array:
    """The one of ``q`` and ``-q`` (..., 4), which are the same rotation, whose first component that is not 0 is > 0.

    So w >= 0. Zeros and what is not a number stay as they are.
    """
    xp = namespace(q)
    # Not xp.sign: array_api_compat's for torch makes the host wait for the device.
    signs = cast(q > 0, q.dtype) - cast(q < 0, q.dtype)
    negative = signs @ constant(_SIGN_WEIGHTS, q) < 0
    return xp.where(negative[..., None], -q, q)


def quat_mul(a: Array, b: Array) -> Array:
    """Hamilton product ``a * b``: rotate by ``b`` first, then by ``a``. Shapes (..., 4)."""
    aw = a[..., 0]
    ax = a[..., 1]
    ay = a[..., 2]
    az = a[..., 3]
    bw = b[..., 0]
    bx = b[..., 1]
    by = b[..., 2]
    bz = b[..., 3]
    parts = [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]
    return namespace(a, b).stack(parts, axis=-1)


def quat_conj(q: Array) -> Array:
    """Conjugate: the inverse rotation of a unit quaternion (..., 4)."""
    return namespace(q).stack([q[..., 0], -q[..., 1], -q[..., 2], -q[..., 3]], axis=-1)


def quat_rotate(q: Array, v: Array) -> Array:
    """Rotate vectors (..., 3) by unit quaternions (..., 4)."""
    w = q[..., 0]
    x = q[..., 1]
    y = q[..., 2]
    z = q[..., 3]
    vx = v[..., 0]
    vy = v[..., 1]
    vz = v[..., 2]
    tx = 2 * (y * vz - z * vy)
    ty = 2 * (z * vx - x * vz)
    tz = 2 * (x * vy - y * vx)
    parts = [
        vx + w * tx + y * tz - z * ty,
        vy + w * ty + z * tx - x * tz,
        vz + w * tz + x * ty - y * tx,
    ]
    return namespace(q, v).stack(parts, axis=-1)


def quat_rotate_inv(q: Array, v: Array) -> Array:
    """Rotate vectors (..., 3) by the inverse of unit quaternions (..., 4)."""
    return quat_rotate(quat_conj(q), v)


def mat_from_quat(q: Array) -> Array:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4); columns are the rotated axes."""
    xp = namespace(q)
    w = q[..., 0]
    x = q[..., 1]
    y = q[..., 2]
    z = q[..., 3]
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)


def quat_from_mat(m: Array) -> Array:
    """Canonical unit quaternions (..., 4) of rotation matrices (..., 3, 3).

    Shepperd's method: of four equivalent forms the one with the largest pivot is taken, so no case is ill-conditioned.
    """
    xp = namespace(m)
    m00 = m[..., 0, 0]
    m11 = m[..., 1, 1]
    m22 = m[..., 2, 2]
    pivots = [
        1 + m00 + m11 + m22,
        1 + m00 - m11 - m22,
        1 - m00 + m11 - m22,
        1 - m00 - m11 + m22,
    ]
    wx = m[..., 2, 1] - m[..., 1, 2]
    wy = m[..., 0, 2] - m[..., 2, 0]
    wz = m[..., 1, 0] - m[..., 0, 1]
    xy = m[..., 1, 0] + m[..., 0, 1]
    xz = m[..., 0, 2] + m[..., 2, 0]
    yz = m[..., 2, 1] + m[..., 1, 2]
    forms = [
        [pivots[0], wx, wy, wz],
        [wx, pivots[1], xy, xz],
        [wy, xy, pivots[2], yz],
        [wz, xz, yz, pivots[3]],
    ]
    best = pivots[0]
    quat = xp.stack(forms[0], axis=-1)
    for pivot, form in zip(pivots[1:], forms[1:], strict=True):
        better = pivot > best
        best = xp.where(better, pivot, best)
        quat = xp.where(better[..., None], xp.stack(form, axis=-1), quat)
    # A matrix in single precision is not quite a rotation.
    quat = quat / xp.sqrt(xp.sum(quat * quat, axis=-1, keepdims=True))
    return quat_canonical(quat)


def quat_from_yaw(yaw: Array) -> Array:
    """Quaternions (..., 4) of rotations about +z by ``yaw`` (...,) [rad]."""
    xp = namespace(yaw)
    zero = xp.zeros_like(yaw)
    return xp.stack([xp.cos(yaw / 2), zero, zero, xp.sin(yaw / 2)], axis=-1)


def yaw_from_quat(q: Array) -> Array:
    """Heading (...,) [rad] in (-pi, pi]: the direction of the rotated x-axis seen from above."""
    w = q[..., 0]
    x = q[..., 1]
    y = q[..., 2]
    z = q[..., 3]
    return namespace(q).atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def quat_from_axis_angle(axis: Array, angle: Array) -> Array:
    """Quaternions (..., 4) of rotations about unit axes (..., 3) by ``angle`` (...,) [rad]."""
    xp = namespace(axis, angle)
    sin = xp.sin(angle / 2)
    parts = xp.broadcast_arrays(
        xp.cos(angle / 2), sin * axis[..., 0], sin * axis[..., 1], sin * axis[..., 2]
    )
    return xp.stack(list(parts), axis=-1)


def pose_mul(a: Array, b: Array) -> Array:
    """Compose poses (..., 7): the pose of frame 2 in 0, from ``a`` = 1 in 0 and ``b`` = 2 in 1."""
    xp = namespace(a, b)
    pos = a[..., :3] + quat_rotate(a[..., 3:], b[..., :3])
    return xp.concat([pos, quat_mul(a[..., 3:], b[..., 3:])], axis=-1)


def pose_inv(pose: Array) -> Array:
    """Inverse poses (..., 7)."""
    quat = quat_conj(pose[..., 3:])
    return namespace(pose).concat([-quat_rotate(quat, pose[..., :3]), quat], axis=-1)


def frame_from_axes(approach: Array, closing: Array) -> Array:
    """Rotations (..., 3, 3) with x along ``approach`` (..., 3) and y along ``closing`` made orthogonal to it."""
    xp = namespace(approach, closing)
    x = approach / xp.sqrt(xp.sum(approach * approach, axis=-1, keepdims=True))
    y = closing - x * xp.sum(closing * x, axis=-1, keepdims=True)
    y = y / xp.sqrt(xp.sum(y * y, axis=-1, keepdims=True))
    x0 = x[..., 0]
    x1 = x[..., 1]
    x2 = x[..., 2]
    y0 = y[..., 0]
    y1 = y[..., 1]
    y2 = y[..., 2]
    z = xp.stack([x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0], axis=-1)
    return xp.stack([x, y, z], axis=-1)


def wrap(angle: np.ndarray | float) -> np.ndarray:
    """Return angles [rad] wrapped to [-pi, pi)."""
    return (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi


def rotation_vector(rot: Array) -> Array:
    """Return the rotation vectors (..., 3) [rad] of rotation matrices (..., 3, 3), with norms in [0, pi]."""
    xp = namespace(rot)
    quat = quat_from_mat(rot)
    sin_half = norm3(quat[..., 1:])
    angle = 2 * xp.atan2(sin_half, quat[..., 0])
    scale = xp.where(
        # Both branches are computed: the smaller bound keeps the unused one from dividing by zero.
        sin_half > 1e-9,
        angle / xp.maximum(sin_half, constant((1e-12,), sin_half)),
        2.0,
    )
    return quat[..., 1:] * scale[..., None]


def euler_xyz(rot: Array) -> Array:
    """Return the Euler angles (..., 3) [rad] of rotation matrices (..., 3, 3): turns about fixed x, then y, then z.

    So ``rot = Rz(third) @ Ry(second) @ Rx(first)``, the second angle in [-pi/2, pi/2], the others in [-pi, pi]. Where
    the second is ±pi/2, only a sum of the others is determined; the third is 0 then, as in
    ``scipy.spatial.transform.Rotation.as_euler("xyz")``.
    """
    xp = namespace(rot)
    level = xp.sqrt(rot[..., 0, 0] ** 2 + rot[..., 1, 0] ** 2)
    # Below, both of the others are noise of rounding.
    free = level > _LOCKED
    first = xp.where(
        free,
        xp.atan2(rot[..., 2, 1], rot[..., 2, 2]),
        xp.atan2(-rot[..., 1, 2], rot[..., 1, 1]),
    )
    second = xp.atan2(-rot[..., 2, 0], level)
    third = xp.where(free, xp.atan2(rot[..., 1, 0], rot[..., 0, 0]), 0.0)
    return xp.stack([first, second, third], axis=-1)


def mat_from_rotation_vector(vector: Array) -> Array:
    """Return the rotation matrices (N, 3, 3) of rotation vectors (N, 3) [rad]."""
    xp = namespace(vector)
    angle = norm3(vector)[:, None, None]
    x = vector[:, 0]
    y = vector[:, 1]
    z = vector[:, 2]
    zero = xp.zeros_like(x)
    skew = xp.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
    # Both branches are computed: without this bound the one that is not taken would divide by zero.
    safe = xp.maximum(angle, constant((1e-9,), angle))
    # Below, the limits are off by less than 1e-12, while 1 - cos would cancel.
    first = xp.where(angle > 1e-6, xp.sin(angle) / safe, 1.0)
    second = xp.where(angle > 1e-6, (1 - xp.cos(angle)) / safe**2, 0.5)
    return constant(IDENTITY_MATRIX, vector) + first * skew + second * (skew @ skew)
