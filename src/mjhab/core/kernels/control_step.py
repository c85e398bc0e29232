"""Loops over the worlds for a control step on the host, compiled: each does in one call what dozens of operations on
small arrays do. Array functions define the numbers, and the kernels name them; the bits are equal.

Letters: W worlds, J joints, P joints of the posture, T targets (objects, then links), B bodies. Numbers of objects,
links and columns are -1 for none, which reads the last row, as in numpy.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from numba.core.types import Array, boolean, float64, int32, int64, void

from mjhab.core.kernels.jit import Decorator, compiler

_TURN = 2 * np.pi
_floats, _flags, _whole, _counts = (
    # Any layout and read-only accepts all arrays; else numba compiles again for each kind of view.
    partial(Array, dtype, layout="A", readonly=True)
    for dtype in (float64, boolean, int64, int32)
)
"""Types of arrays that are read, by their number of axes."""


def _kernel(
    read: Sequence[Any], written: Sequence[Any], returned: Any = void
) -> Decorator:
    """A kernel of one signature: arrays of any memory layout take the same machine code."""
    signature = returned(*read, *written)
    return compiler("core.kernels.control_step", signature_or_function=signature)


@_kernel(
    (
        _floats(4),
        _flags(2),
        _flags(2),
        _whole(2),
        _floats(3),
        _floats(4),
        _whole(1),
        _floats(2),
    ),
    (float64[:, :, :, :], boolean[:, :], float64[:, :], float64[:, :, :]),
)
def sense_hand(
    finger_force: np.ndarray,
    touch: np.ndarray,
    ee_contact: np.ndarray,
    columns: np.ndarray,
    body_pos: np.ndarray,
    body_mat: np.ndarray,
    fingers: np.ndarray,
    opening: np.ndarray,
    force: np.ndarray,
    contact: np.ndarray,
    tcp_pos: np.ndarray,
    finger_dir: np.ndarray,
) -> None:
    """What the hand feels, see `Sensing.felt`.

    Args:
        finger_force: (W, 2, T, 3) force of each target on the fingers [N].
        touch: (W, T) a robot link touches the target.
        ee_contact: (W, T) a finger or the hand does.
        columns: (W, 2) of T: the target of the active subtask, and the object that is carried.
        body_pos: (W, B, 3) [m].
        body_mat: (W, B, 3, 3).
        fingers: (2,) of B.
        opening: (2, 3) direction in which each finger opens, in its frame.
        force: written: (W, 2, 2, 3) of the two columns on the two fingers.
        contact: written: (2, W) ``touch`` and ``ee_contact`` of the target.
        tcp_pos: written: (W, 3) the middle between the fingers.
        finger_dir: written: (W, 2, 3) ``opening`` in the world.
    """
    for w in range(len(columns)):
        for c in range(2):
            column = columns[w, c]
            # A factor and no branch: the array function multiplies by its mask, and negative zeros must agree, too.
            scale = 1.0 if column >= 0 else 0.0
            for f in range(2):
                for k in range(3):
                    force[w, c, f, k] = finger_force[w, f, column, k] * scale
        target = columns[w, 0]
        contact[0, w] = target >= 0 and touch[w, target]
        contact[1, w] = target >= 0 and ee_contact[w, target]
        for k in range(3):
            middle = body_pos[w, fingers[0], k] + body_pos[w, fingers[1], k]
            tcp_pos[w, k] = middle / 2.0
            for f in range(2):
                turn = body_mat[w, fingers[f], k]
                along = turn[0] * opening[f, 0] + turn[1] * opening[f, 1]
                finger_dir[w, f, k] = along + turn[2] * opening[f, 2]


@_kernel(
    (
        _floats(3),
        _floats(3),
        _floats(3),
        _flags(1),
        _floats(2),
        _floats(2),
        _floats(1),
        _floats(1),
    ),
    (boolean[:, :], float64[:]),
)
def check_hand(
    finger_force: np.ndarray,
    held_force: np.ndarray,
    finger_dir: np.ndarray,
    carries: np.ndarray,
    tcp_pos: np.ndarray,
    base: np.ndarray,
    turn: np.ndarray,
    limits: np.ndarray,
    found: np.ndarray,
    total: np.ndarray,
) -> None:
    """Whether the hand grasps, presses and is at its rest point, see `tasks.measure.check_body`.

    Args:
        finger_force: (W, 2, 3) force of the target on the fingers [N].
        held_force: (W, 2, 3) of the object that is carried, which counts where ``carries`` (W,).
        finger_dir: (W, 2, 3) directions in which the fingers open.
        carries: see ``held_force``.
        tcp_pos: (W, 3) [m].
        base: (W, 3) x, y [m], yaw.
        turn: (2 W,) cosines, then sines of the yaw.
        limits: (6,) least cosine between force and direction, least force of a finger [N], rest point x, y in front of
            the base, its height, and the largest distance from it [m].
        found: written: (3, W) both fingers press well; one of them presses; the hand is at rest.
        total: written: (W,) force of both fingers [N].
    """
    worlds = len(total)
    cos_angle, least, rest_x, rest_y, rest_z, near = limits
    for w in range(worlds):
        both = True
        pressed = 0.0
        for f in range(2):
            force = held_force[w, f] if carries[w] else finger_force[w, f]
            to = finger_dir[w, f]
            square = force[0] * force[0] + force[1] * force[1] + force[2] * force[2]
            along = force[0] * to[0] + force[1] * to[1] + force[2] * to[2]
            norm = np.sqrt(square)
            both = both and norm >= least and along >= cos_angle * norm
            pressed += norm
        cos = turn[w]
        sin = turn[worlds + w]
        dx = tcp_pos[w, 0] - (base[w, 0] + cos * rest_x - sin * rest_y)
        dy = tcp_pos[w, 1] - (base[w, 1] + sin * rest_x + cos * rest_y)
        dz = tcp_pos[w, 2] - rest_z
        found[0, w] = both
        found[1, w] = pressed > 0.0
        found[2, w] = np.sqrt(dx * dx + dy * dy + dz * dz) <= near
        total[w] = pressed


@_kernel(
    (_floats(2), _floats(2), _floats(2), _floats(1), _floats(1), _floats(1), boolean),
    (boolean[:, :],),
)
def check_joints(
    posture: np.ndarray,
    speed: np.ndarray,
    tolerance: np.ndarray,
    rest: np.ndarray,
    per_turn: np.ndarray,
    limits: np.ndarray,
    absolute: bool,
    found: np.ndarray,
) -> None:
    """Whether the joints are near rest and stand still, see `tasks.measure.check_body`.

    Args:
        posture: (W, P) joint positions [m or rad].
        speed: (W, 3 + P) velocities, of the base first.
        tolerance: (W, P) largest distance from rest.
        rest: (P,).
        per_turn: (P,) turns per radian of joints without limits, 0 for others.
        limits: (3 + P,) largest speeds.
        absolute: of speeds the absolute value counts.
        found: written: (2, W) near rest; still.
    """
    for w in range(len(posture)):
        near = True
        for j in range(len(rest)):
            off = posture[w, j] - rest[j]
            off = off - _TURN * np.rint(off * per_turn[j])
            near = near and abs(off) <= tolerance[w, j]
        still = True
        for j in range(len(limits)):
            # Published stillness compares the signed speed.
            fast = abs(speed[w, j]) if absolute else speed[w, j]
            still = still and fast <= limits[j]
        found[0, w] = near
        found[1, w] = still


@_kernel(
    (_floats(2), float64, _floats(3), _floats(3), _flags(3)),
    (float64[:, :, :],),
)
def poses_in_base(
    base: np.ndarray,
    height: float,
    trig: np.ndarray,
    poses: np.ndarray,
    shown: np.ndarray,
    out: np.ndarray,
) -> None:
    """Write poses ``out`` (N, W, 7) in the frame of the base link, see `observations.state.pose_in_base`.

    Args:
        base: (W, 3) x, y [m], yaw.
        height: of the base link [m].
        trig: (4, W, 1) cosine and sine of the yaw, then of half of it.
        poses: (N, W, 7) in the world [m, wxyz].
        shown: (N, W, 1) others become zero.
        out: see above.
    """
    for w in range(len(base)):
        cos = trig[0, w, 0]
        sin = trig[1, w, 0]
        cos_half = trig[2, w, 0]
        sin_half = trig[3, w, 0]
        for n in range(len(poses)):
            pose = poses[n, w]
            own = out[n, w]
            scale = 1.0 if shown[n, w, 0] else 0.0
            x = pose[0] - base[w, 0]
            y = pose[1] - base[w, 1]
            own[0] = (cos * x + sin * y) * scale
            own[1] = (cos * y + -sin * x) * scale
            own[2] = (pose[2] - height) * scale
            own[3] = cos_half * pose[3] + sin_half * pose[6]
            own[4] = cos_half * pose[4] + sin_half * pose[5]
            own[5] = cos_half * pose[5] + -sin_half * pose[4]
            own[6] = cos_half * pose[6] + -sin_half * pose[3]
            sign = 1.0
            for k in range(3, 7):
                if own[k] > 0.0:
                    break
                if own[k] < 0.0:
                    sign = -1.0
                    break
            for k in range(3, 7):
                own[k] = own[k] * sign * scale


@_kernel((_floats(2), int64, float64, _counts(2), _counts(2), _floats(2)), (), boolean)
def is_sound(
    sensors: np.ndarray,
    depth: int,
    least: float,
    warnings: np.ndarray,
    warned: np.ndarray,
    qpos: np.ndarray,
) -> bool:
    """Whether a step has made nothing that `CpuSimulator` must look into.

    Args:
        sensors: (W, D) sensor data; column ``depth`` is the least distance of the robot's contacts [m].
        depth: see ``sensors``.
        least: smallest depth that is sound [m].
        warnings: (W, N) numbers of the engine's warnings, ``warned`` of which are known.
        warned: (W, N).
        qpos: (W, Q) numbers that must be finite.
    """
    for w in range(len(qpos)):
        if sensors[w, depth] < least:
            return False
        for kind in range(warned.shape[1]):
            if warnings[w, kind] > warned[w, kind]:
                return False
        for k in range(qpos.shape[1]):
            if not np.isfinite(qpos[w, k]):
                return False
    return True
