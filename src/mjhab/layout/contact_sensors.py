"""Contact sensors of a model: which contacts they list, and the sum of contact normals that forces are made of.

The original's engine reports contact forces as sums of normals times their magnitude, without friction (PhysX: SAPIEN's
``physx_system.cu`` and ``physx_system.cpp`` add ``normal * impulse``). MuJoCo's net-force sensors include friction, so
that a force sensor here lists its contacts one by one and `normal_force` adds their normals.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

_FIELD = mujoco.mjtConDataField
_FOUND = int(_FIELD.mjCONDATA_FOUND)
_FORCE = int(_FIELD.mjCONDATA_FORCE)
_DIST = int(_FIELD.mjCONDATA_DIST)
_NORMAL = int(_FIELD.mjCONDATA_NORMAL)
_MINDIST = 1
_MAXFORCE = 2
_NETFORCE = 3

CONTACT_SLOTS = 8
"""Contacts that a force sensor lists, the strongest first. A finger on an object makes up to 6 contacts per convex
piece (4 of the pad's box, 2 of its rounded edge)."""
SLOT_WIDTH = 7
"""Numbers per contact: how many contacts match (0 in an empty slot), force in the contact frame (3), normal (3)."""
FORCE_SENSOR_WIDTH = CONTACT_SLOTS * SLOT_WIDTH


@dataclass(frozen=True)
class _Readings:
    """What a contact sensor writes: the fields of its contacts, which contacts it keeps, and how many of them."""

    fields: tuple[int, ...]
    reduce: int
    slots: int = 1


def add_force_sensor(spec: mujoco.MjSpec, name: str, body1: str, body2: str = "") -> None:
    """Add a sensor of the contacts of ``body1`` with ``body2`` ("": with anything); read it with `normal_force`."""
    _add_sensor(
        spec, name, body1, body2, _Readings((_FOUND, _FORCE, _NORMAL), _MAXFORCE, CONTACT_SLOTS)
    )


def add_touch_sensor(
    spec: mujoco.MjSpec, name: str, body1: str, body2: str, *, whole_subtree: bool
) -> None:
    """Add a sensor of one number: how many contacts ``body2`` has with ``body1``, or with all bodies from it down."""
    _add_sensor(spec, name, body1, body2, _Readings((_FOUND,), _NETFORCE), whole_subtree)


def add_depth_sensor(spec: mujoco.MjSpec, name: str, subtree: str) -> None:
    """Add a sensor of one number: the least distance [m] of the contacts of the bodies from ``subtree`` down."""
    _add_sensor(spec, name, subtree, "", _Readings((_DIST,), _MINDIST), whole_subtree=True)


def _add_sensor(
    spec: mujoco.MjSpec,
    name: str,
    body1: str,
    body2: str,
    readings: _Readings,
    whole_subtree: bool = False,
) -> None:
    # A reference of type XBODY on the first side stands for the whole subtree below that body.
    kind = mujoco.mjtObj.mjOBJ_XBODY if whole_subtree else mujoco.mjtObj.mjOBJ_BODY
    sensor = spec.add_sensor(
        name=name, type=mujoco.mjtSensor.mjSENS_CONTACT, objname=body1, objtype=kind
    )
    if body2:
        sensor.reftype = mujoco.mjtObj.mjOBJ_BODY
        sensor.refname = body2
    fields = sum(1 << field for field in readings.fields)
    sensor.intprm = [fields, readings.reduce, readings.slots]


def normal_force(readings: np.ndarray) -> np.ndarray:
    """Sum of normal force times normal over the contacts that force sensors list.

    Args:
        readings: (..., FORCE_SENSOR_WIDTH) data of force sensors.

    Returns:
        (..., 3) force [N] of the sensor's first body on the other, world frame. A contact beyond the CONTACT_SLOTS
        strongest is missing.
    """
    slots = readings.reshape(*readings.shape[:-1], CONTACT_SLOTS, SLOT_WIDTH)
    magnitude = slots[..., 1:2]
    normal = slots[..., 4:7]
    return (magnitude * normal).sum(axis=-2)
