"""Contact sensors of a model, and normal contact forces computed from their data.

MS-HAB's contact forces are sums of normal forces without friction (PhysX: SAPIEN's ``physx_system.cu`` and
``physx_system.cpp`` add ``normal * impulse``). MuJoCo's net-force sensors include friction. So a force sensor here
lists its contacts one by one, and `normal_force` sums their normal forces.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

_FIELD = mujoco.mjtConDataField
_FOUND = int(_FIELD.mjCONDATA_FOUND)
_FORCE = int(_FIELD.mjCONDATA_FORCE)
_DIST = int(_FIELD.mjCONDATA_DIST)
_POS = int(_FIELD.mjCONDATA_POS)
_NORMAL = int(_FIELD.mjCONDATA_NORMAL)
_MINDIST = 1
_MAXFORCE = 2

CONTACT_SLOTS = 16
"""Contacts that a sensor lists, those with the largest force first. A finger on an object makes up to 6 contacts per
convex piece (4 of the pad's box, 2 of its rounded edge)."""
_FORCE_SLOT = 10
"""Numbers per contact of a force sensor: how many contacts match (0 in an empty slot), force in the contact frame (3),
position (3), normal (3)."""
_TOUCH_SLOT = 4
"""Numbers per contact of a touch sensor: how many contacts match (0 in an empty slot), position (3)."""
FORCE_SENSOR_WIDTH = CONTACT_SLOTS * _FORCE_SLOT
TOUCH_SENSOR_WIDTH = CONTACT_SLOTS * _TOUCH_SLOT


@dataclass(frozen=True)
class _Readings:
    """Data of a contact sensor: fields per contact, MuJoCo's ``reduce`` criterion, and number of contacts kept."""

    fields: tuple[int, ...]
    reduce: int
    slots: int = 1


def add_force_sensor(spec: mujoco.MjSpec, name: str, body: str) -> None:
    """Add a sensor that lists all contacts of ``body``; `normal_force` and `pair_force` read its data."""
    readings = _Readings((_FOUND, _FORCE, _POS, _NORMAL), _MAXFORCE, CONTACT_SLOTS)
    _add_sensor(spec, name, body, "", readings)


def add_touch_sensor(spec: mujoco.MjSpec, name: str, subtree: str, body: str) -> None:
    """Add a sensor that lists the contacts of ``body`` with ``subtree`` and its descendants.

    The first number is the count of contacts. `pair_force` uses it to select the contacts of a force sensor that are
    with ``body``. This replaces a force sensor per pair of bodies: the engine evaluates every sensor in every substep,
    and each takes time even without contacts.
    """
    readings = _Readings((_FOUND, _POS), _MAXFORCE, CONTACT_SLOTS)
    _add_sensor(spec, name, subtree, body, readings, whole_subtree=True)


def add_depth_sensor(spec: mujoco.MjSpec, name: str, subtree: str) -> None:
    """Add a sensor of one number: the least contact distance [m] of ``subtree`` and its descendants."""
    _add_sensor(
        spec, name, subtree, "", _Readings((_DIST,), _MINDIST), whole_subtree=True
    )


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
    """Return the net normal force over the contacts that force sensors list.

    Args:
        readings: (..., FORCE_SENSOR_WIDTH) data of force sensors.

    Returns:
        (..., 3) force [N] of the sensor's body on others, world frame. Contacts beyond the CONTACT_SLOTS strongest are
        not in it.
    """
    return _normals(_slots(readings, _FORCE_SLOT)).sum(axis=-2)


def pair_force(
    readings: np.ndarray, touches: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the net normal force over the contacts that a force sensor and a touch sensor both list.

    Contacts are matched by position, which is bitwise the same in every sensor that lists a contact.

    Args:
        readings: (..., FORCE_SENSOR_WIDTH) data of force sensors.
        touches: (..., TOUCH_SENSOR_WIDTH) data of touch sensors, each of a subtree that contains the body of the force
            sensor.

    Returns:
        (..., 3) force [N] of the force sensor's body on that of the touch sensor, world frame; and (...) bool: they
        have a contact.
    """
    listed = _slots(readings, _FORCE_SLOT)
    touched = _slots(touches, _TOUCH_SLOT)
    # Exactly equal and not within a tolerance: two contacts may lie closer than any.
    same = (listed[..., :, None, 4:7] == touched[..., None, :, 1:4]).all(axis=-1)
    # Empty slots are zeros, which would match each other.
    same &= (listed[..., :, None, 0] > 0) & (touched[..., None, :, 0] > 0)
    common = same.any(axis=-1)
    force = np.where(common[..., None], _normals(listed), 0.0).sum(axis=-2)
    return force, common.any(axis=-1)


def _slots(readings: np.ndarray, width: int) -> np.ndarray:
    return readings.reshape(*readings.shape[:-1], CONTACT_SLOTS, width)


def _normals(listed: np.ndarray) -> np.ndarray:
    """Return (..., CONTACT_SLOTS, 3): normal force vectors [N] of the contacts of force sensors, world frame."""
    # The first number in the contact's frame is the normal force.
    return listed[..., 1:2] * listed[..., 7:10]
