"""Sizes [m] of Fetch's gripper: bounds of its meshes (mani_skill/assets/robots/fetch)."""

from __future__ import annotations

from mjhab.robots.parts import Gripper, Sphere

_PALM_RADIUS = 0.03
_WRIST_RADIUS = 0.054
_PALM_X = (-0.062, -0.093, -0.124)
_PALM_Y = (-0.036, 0.0, 0.036)
_PALM_Z = (-0.012, 0.012)
_WRIST_X = (-0.18, -0.23, -0.28)
_PALM = tuple(
    Sphere((x, y, z), _PALM_RADIUS) for x in _PALM_X for y in _PALM_Y for z in _PALM_Z
)
_WRIST = tuple(Sphere((x, 0.0, 0.0), _WRIST_RADIUS) for x in _WRIST_X)

GRIPPER = Gripper(
    finger=(0.030, 0.0132),
    thickness=0.0144,
    palm_x=(-0.154, -0.032),
    palm_half=(0.063, 0.040),
    opening=0.0985,
    usable=0.092,
    shelf_usable=0.0945,
    hand=_PALM[:15] + _WRIST,
)
