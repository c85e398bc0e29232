"""Masses and collision shapes of the Fetch robot, link by link.

Masses come from the Fetch description file (fetch.urdf of ManiSkill's ``assets/robots/fetch``). Collision shapes
are primitives, several per link, fitted to the published collision meshes: they stay within the bounding box of the
mesh of their link and come within 5 mm of it on most sides. They leave out rounded edges, and hollows that a convex
hull would fill. All poses are in the link frame. Lengths [m], masses [kg], inertias [kg m^2].
"""

from __future__ import annotations

from mjhab.robots.parts import Inertial
from mjhab.scenes.spec import Geom, Quat, Vec3

ALONG_X: Quat = (0.7071067811865476, 0.0, 0.7071067811865476, 0.0)
"""Turns the axis of a cylinder (z) to x."""
ALONG_Y: Quat = (0.7071067811865476, -0.7071067811865476, 0.0, 0.0)
"""Turns the axis of a cylinder (z) to y."""


def _inertial(
    mass: float, com: Vec3, inertia: tuple[float, float, float, float, float, float]
) -> Inertial:
    """Make an `Inertial` from an inertia [kg m^2] in URDF's order xx, xy, xz, yy, yz, zz."""
    xx, xy, xz, yy, yz, zz = inertia
    return Inertial(mass, com, (xx, yy, zz, xy, xz, yz))


_WHEEL = _inertial(4.3542, (0.0, 0.0, 0.0), (0.0045, 0.0, 0.0, 0.005, 0.0, 0.0045))
_BELLOWS = _inertial(
    0.169374, (0.019132, 0.0, -0.134862), (0.003312, 0.0, 0.0, 0.001744, 0.0, 0.001694)
)
# The URDF gives a finger xx = 0.002, which violates xx <= yy + zz with yy = zz = 0.0002; 0.0004 is the nearest valid.
_FINGER = _inertial(0.0798, (-0.01, 0.0, 0.0), (0.0004, 0.0, 0.0, 0.0002, 0.0, 0.0002))

INERTIALS: dict[str, Inertial] = {
    "base_link": _inertial(
        70.1294, (-0.0036, 0.0, 0.0014), (1.225, 0.0099, 0.0062, 1.2853, -0.0034, 0.987)
    ),
    "r_wheel_link": _WHEEL,
    "l_wheel_link": _WHEEL,
    "estop_link": _inertial(
        0.001961, (0.00243, -0.00331, 0.00665), (3e-7, 0.0, 0.0, 3e-7, 0.0, 3e-7)
    ),
    "laser_link": _inertial(
        0.008336, (-0.0306, 0.0007, 0.0552), (1.02e-6, 0.0, 0.0, 5.1e-7, 0.0, 1.27e-6)
    ),
    "torso_fixed_link": _inertial(
        13.2775,
        (-0.0722, 0.0057, 0.2656),
        (0.3861, 0.0015, -0.0102, 0.3388, 0.0117, 0.1018),
    ),
    "torso_lift_link": _inertial(
        10.7796,
        (-0.0013, -0.0009, 0.2935),
        (0.3354, 0.0, -0.0162, 0.3354, -0.0006, 0.0954),
    ),
    "bellows_link": _BELLOWS,
    "bellows_link2": _BELLOWS,
    "head_pan_link": _inertial(
        2.2556, (0.0321, 0.0161, 0.0390), (0.0129, 0.0002, 0.0007, 0.0095, 0.0, 0.0184)
    ),
    "head_tilt_link": _inertial(
        0.9087, (0.0081, 0.0025, 0.0113), (0.0061, 0.0, 0.0002, 0.0014, -0.0001, 0.0061)
    ),
    "shoulder_pan_link": _inertial(
        2.5587,
        (0.0927, -0.0056, 0.0564),
        (0.0043, -0.0001, 0.001, 0.0087, -0.0001, 0.0087),
    ),
    "shoulder_lift_link": _inertial(
        2.6615, (0.1432, 0.0072, -0.0001), (0.0028, -0.0021, 0.0, 0.0111, 0.0, 0.0112)
    ),
    "upperarm_roll_link": _inertial(
        2.3311, (0.1165, 0.0014, 0.0), (0.0019, -0.0001, 0.0, 0.0045, 0.0, 0.0047)
    ),
    "elbow_flex_link": _inertial(
        2.1299, (0.1279, 0.0073, 0.0), (0.0024, -0.0016, 0.0, 0.0082, 0.0, 0.0084)
    ),
    "forearm_roll_link": _inertial(
        1.6563, (0.1097, -0.0266, 0.0), (0.0016, -0.0003, 0.0, 0.003, 0.0, 0.0035)
    ),
    "wrist_flex_link": _inertial(
        1.725, (0.0882, 0.0009, -0.0001), (0.0018, -0.0001, 0.0, 0.0042, 0.0, 0.0042)
    ),
    "wrist_roll_link": _inertial(
        0.1354, (0.0095, 0.0004, -0.0002), (0.0001, 0.0, 0.0, 0.0001, 0.0, 0.0001)
    ),
    "gripper_link": _inertial(
        1.5175, (-0.0900, -0.0001, -0.0017), (0.0013, 0.0, 0.0, 0.0019, 0.0, 0.0024)
    ),
    "r_gripper_finger_link": _FINGER,
    "l_gripper_finger_link": _FINGER,
}


def _box(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> Geom:
    low, high = zip(x, y, z, strict=True)
    half = [0.5 * (b - a) for a, b in zip(low, high, strict=True)]
    mid = [0.5 * (a + b) for a, b in zip(low, high, strict=True)]
    return Geom(
        "box", (half[0], half[1], half[2]), (mid[0], mid[1], mid[2]), visual=False
    )


def _cylinder(
    axis: str,
    radius: float,
    span: tuple[float, float],
    at: tuple[float, float] = (0.0, 0.0),
) -> Geom:
    """Make a cylinder along ``axis`` over ``span``; ``at``: its two other coordinates, in order [m]."""
    half = 0.5 * (span[1] - span[0])
    mid = 0.5 * (span[0] + span[1])
    if axis == "x":
        return Geom("cylinder", (radius, half, 0.0), (mid, *at), ALONG_X, visual=False)
    if axis == "y":
        return Geom(
            "cylinder", (radius, half, 0.0), (at[0], mid, at[1]), ALONG_Y, visual=False
        )
    return Geom("cylinder", (radius, half, 0.0), (*at, mid), visual=False)


FINGER_HALF: Vec3 = (0.030, 0.0072, 0.0132)
"""Half-extents of a finger box [m]."""
_PAD_FACE = 0.0004
# In gripper_link at joint value q the right finger fills y in [q - 0.0004, q + 0.0140], its origin at q + 0.015425.
_FINGER_Y = FINGER_HALF[1] - _PAD_FACE - 0.015425


TIP_RADIUS = 0.004
"""Radius [m] of the pad's edge at the fingertip. The contact normal of a sharp edge against an object wider than the
opening is undefined: it may flip to the finger's end face and push the object out of the hand."""


def finger_box(sign: float) -> Geom:
    """Return the box around a finger, in its link frame; ``sign``: 1 right finger (+y of the gripper), -1 left."""
    return Geom("box", FINGER_HALF, (0.001, sign * _FINGER_Y, 0.0), visual=False)


def _finger(sign: float) -> tuple[Geom, ...]:
    """Return the collision shapes of a finger: `finger_box` with a rounded edge at the end of the pad."""
    (x, y, z) = FINGER_HALF
    end = 0.001 + FINGER_HALF[0]
    box = _box(
        (end - 2 * x, end - TIP_RADIUS - 0.001),
        (sign * _FINGER_Y - y, sign * _FINGER_Y + y),
        (-z, z),
    )
    # Inside the face of the pad, so that the opening stays that of the mesh.
    edge = (end - TIP_RADIUS, sign * (_FINGER_Y - y + TIP_RADIUS), 0.0)
    return box, Geom("capsule", (TIP_RADIUS, z - TIP_RADIUS, 0.0), edge, visual=False)


COLLISION: dict[str, tuple[Geom, ...]] = {
    "base_link": (
        _cylinder("z", 0.264, (0.01, 0.359)),
        _box((-0.245, 0.245), (-0.144, 0.144), (0.01, 0.359)),
        _box((-0.279, 0.279), (-0.055, 0.055), (0.025, 0.359)),
    ),
    "torso_fixed_link": (
        _box((-0.140, -0.032), (-0.155, 0.155), (-0.019, 0.443)),
        _box((-0.168, -0.140), (-0.120, 0.120), (-0.019, 0.443)),
    ),
    "torso_lift_link": (
        _box((-0.150, 0.030), (-0.166, 0.166), (0.029, 0.560)),
        _box((-0.183, -0.150), (-0.130, 0.130), (0.029, 0.560)),
        _box((-0.130, 0.095), (-0.090, 0.090), (0.500, 0.600)),
        _box((0.030, 0.119525), (-0.052, 0.052), (0.185, 0.301)),
        _cylinder("z", 0.052, (0.185, 0.301), (0.119525, 0.0)),
        _box((-0.033, 0.037), (-0.145, 0.145), (-0.298, 0.029)),
    ),
    "head_pan_link": (
        _box((-0.020, 0.190), (-0.143, 0.143), (0.004, 0.100)),
        _box((-0.085, -0.020), (-0.110, 0.110), (0.002, 0.075)),
        _cylinder("x", 0.036, (-0.118, -0.085), (0.0, 0.037)),
    ),
    "head_tilt_link": (_cylinder("y", 0.055, (-0.105, 0.105)),),
    "shoulder_pan_link": (
        _cylinder("z", 0.050, (-0.048, 0.060)),
        _box((0.030, 0.120), (-0.066, 0.018), (0.000, 0.108)),
        _cylinder("y", 0.059, (-0.075, 0.008), (0.117, 0.060)),
    ),
    "shoulder_lift_link": (
        _cylinder("y", 0.060, (-0.010, 0.071)),
        _cylinder("x", 0.052, (0.040, 0.172), (0.003, 0.0)),
    ),
    "upperarm_roll_link": (
        _cylinder("x", 0.052, (-0.048, 0.090), (-0.008, 0.0)),
        _cylinder("y", 0.052, (-0.071, 0.012), (0.133, 0.0)),
    ),
    "elbow_flex_link": (
        _cylinder("y", 0.052, (-0.010, 0.071)),
        _cylinder("x", 0.052, (0.036, 0.166), (0.004, 0.0)),
    ),
    "forearm_roll_link": (
        _cylinder("x", 0.052, (-0.032, 0.050), (-0.008, 0.0)),
        _box((0.030, 0.1245), (-0.078, -0.006), (-0.050, 0.050)),
        _cylinder("y", 0.052, (-0.087, -0.030), (0.1245, 0.0)),
    ),
    "wrist_flex_link": (
        _cylinder("y", 0.052, (-0.054, 0.067)),
        _cylinder("x", 0.052, (0.020, 0.116)),
    ),
    "wrist_roll_link": (_cylinder("x", 0.052, (-0.023, 0.010)),),
    "gripper_link": (_box((-0.154, -0.032), (-0.062, 0.062), (-0.037, 0.037)),),
    "r_gripper_finger_link": _finger(1.0),
    "l_gripper_finger_link": _finger(-1.0),
}
"""Collision shapes by link. The wheels have none, because the base has no contact with the floor."""
