"""Validation of the names and numbers of an asset pack when it is read.

MuJoCo and the free-space maps do not check numbers: a length of 1e300 m crashes them, and a mass of 0 or a quaternion
of length 3 gives meaningless physics.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.core.errors import about, wrong_value
from mjhab.core.names import check_name
from mjhab.scenes.spec import (
    Geom,
    Handle,
    Home,
    Light,
    Link,
    LinkInertial,
    ObjectType,
    Pack,
    Placement,
    Receptacle,
)

MAX_FILE_NUMBER = 1000.0
"""Largest absolute number in the files of a pack: positions [m], angles [rad], masses [kg], scales, vertices."""
MAX_POSITION_M = 100.0
"""Largest absolute coordinate of a position in the frame of a home or template [m]; parked pieces are at 50 m."""
MIN_SIZE_M = 1e-5
"""Smallest half-extent, radius or half-length of a shape [m]."""
MAX_SIZE_M = 100.0
"""Largest half-extent, radius or half-length of a shape [m]."""
MIN_MESH_SCALE = 1e-4
"""Smallest factor from the vertices of a mesh to metres; meshes may be in millimetres."""
MAX_MESH_SCALE = 1000.0
MIN_MASS_KG = 1e-4
MAX_MASS_KG = 1000.0
MAX_ANGLE_RAD = 4 * math.pi
MAX_JOINT_POSITION = 10.0
"""Largest joint position [m or rad]."""
MAX_INERTIA = 1e4
"""Largest entry of the inertia of a link [kg m^2]."""
MAX_RESISTANCE = 1000.0
"""Largest damping [N s/m or N m s/rad] and dry friction [N or N m] of a joint."""
MAX_LIGHT = 1000.0
"""Largest intensity or colour component of a light [1]."""
MAX_LAYOUT = 9999
"""Largest number of a macro or micro layout."""
UNIT_TOLERANCE = 0.05
"""Allowed deviation of the length of a direction or quaternion from 1, because files have few digits."""

_LENGTH = (-MAX_POSITION_M, MAX_POSITION_M, "m")
_SIZE = (MIN_SIZE_M, MAX_SIZE_M, "m")
_MASS = (MIN_MASS_KG, MAX_MASS_KG, "kg")
_ANGLE = (-MAX_ANGLE_RAD, MAX_ANGLE_RAD, "rad")
_JOINT = (-MAX_JOINT_POSITION, MAX_JOINT_POSITION, "m or rad")
_INERTIA = (-MAX_INERTIA, MAX_INERTIA, "kg m^2")
_RESISTANCE = (0.0, MAX_RESISTANCE, "N, N m, or per speed")
_LIGHT = (0.0, MAX_LIGHT, "1")

RANGES: dict[tuple[type, str], tuple[float, float, str]] = {
    (Geom, "pos"): _LENGTH,
    (Receptacle, "pos"): _LENGTH,
    (Receptacle, "half"): _SIZE,
    (Receptacle, "height"): (0.0, MAX_SIZE_M, "m"),
    (Handle, "pos"): _LENGTH,
    (Handle, "half_length"): _SIZE,
    (Handle, "thickness"): _SIZE,
    (Link, "pos"): _LENGTH,
    (Link, "mass"): _MASS,
    (Link, "damping"): _RESISTANCE,
    (Link, "friction"): _RESISTANCE,
    (Link, "range"): _JOINT,
    (LinkInertial, "com"): _LENGTH,
    (LinkInertial, "inertia"): _INERTIA,
    (Placement, "pos"): _LENGTH,
    (Placement, "yaw"): _ANGLE,
    (Light, "pos"): _LENGTH,
    (Light, "color"): _LIGHT,
    (Light, "intensity"): _LIGHT,
    (Home, "floor"): _LENGTH,
    (Home, "macro"): (0, MAX_LAYOUT, "1"),
    (Home, "micro"): (0, MAX_LAYOUT, "1"),
    (ObjectType, "mass"): _MASS,
    (ObjectType, "half"): _SIZE,
    (ObjectType, "scan_yaw"): _ANGLE,
}
"""Smallest value, largest value and unit of the numbers of a field."""
UNIT_VECTORS = frozenset(
    {
        (Geom, "quat"),
        (Placement, "quat"),
        (Handle, "bar"),
        (Handle, "out"),
        (Link, "axis"),
    }
)
"""Fields that are directions or quaternions of length 1."""
NAMES = frozenset({"name", "template", "mesh", "link", "material", "pack"})
"""Fields that are names, in all dataclasses."""
MAY_BE_EMPTY = frozenset({"mesh", "link"})
NUMBERS_OF_SIZE = {"box": 3, "cylinder": 2, "capsule": 2, "sphere": 1}
"""Number of entries of `Geom.size` that a shape uses."""


def check_pack(pack: Pack, source: Path | str) -> Pack:
    """Check all names and numbers of a pack, and return it.

    Args:
        pack: the pack that was read.
        source: its file, for messages.

    Raises:
        UsageError: a name is invalid, a number is not finite or out of its range (`RANGES`, `UNIT_VECTORS`), an object
            or a link has no geom that collides, or a link collides as a mesh; the message names the field.
    """
    with about(source):
        check_name("name of the pack", pack.name)
        # Once per mesh: hundreds of geoms name the same ones.
        extents = {name: _mesh_extent(name, mesh) for name, mesh in pack.meshes.items()}
        passed: set[int] = set()
        _check_each("props", pack.props.values(), extents, passed)
        _check_each("articulations", pack.articulations.values(), extents, passed)
        _check_each("objects", pack.objects.values(), extents, passed)
        _check_each("homes", pack.homes, extents, passed)
    return pack


def _check_each(
    where: str, things: Iterable[Any], extents: Mapping[str, float], passed: set[int]
) -> None:
    for k, thing in enumerate(things):
        _check(f"{where}[{k}]", thing, extents, passed)


def _check(
    where: str, thing: Any, extents: Mapping[str, float], passed: set[int]
) -> None:
    """Check a dataclass recursively.

    Args:
        where: its place in the pack, for messages.
        thing: the dataclass.
        extents: largest absolute vertex coordinate of every mesh, by name.
        passed: identities of the tuples of the pack that were checked, which is extended.
    """
    kind = type(thing)
    for field in fields(thing):
        value = getattr(thing, field.name)
        place = f"{where}.{field.name}"
        if field.name in NAMES:
            check_name(place, value, empty=field.name in MAY_BE_EMPTY)
        if (kind, field.name) in RANGES:
            check_range(place, value, *RANGES[kind, field.name])
        if (kind, field.name) in UNIT_VECTORS and value is not None:
            _check_unit(place, value)
        if is_dataclass(value):
            _check(place, value, extents, passed)
        # Homes of one floor plan share their walls: a hundred boxes, 84 times in ReplicaCAD.
        if isinstance(value, tuple) and id(value) not in passed:
            passed.add(id(value))
            _check_each(place, filter(is_dataclass, value), extents, passed)
    if isinstance(thing, Geom):
        _check_size(f"{where}.size", thing, extents.get(thing.mesh, 0.0))
    if isinstance(thing, Link):
        _check_link(where, thing)
    if isinstance(thing, LinkInertial):
        _check_inertial(where, thing)
    if isinstance(thing, ObjectType):
        _check_solid(f"{where}.collision", thing.collision)
    if isinstance(thing, Home):
        _check_home(where, thing)


def check_range(where: str, value: Any, low: float, high: float, unit: str) -> None:
    """Refuse a number, or a tuple or array of them, outside of [low, high] or not finite.

    Raises:
        ValueError: says where, which number, and the range.
    """
    for number in np.ravel(np.asarray(value, np.float64)).tolist():
        # Negated, so that NaN is refused.
        if not low <= number <= high:
            expected = f"in the range {low:g} to {high:g} [{unit}]"
            raise wrong_value(where, number, expected)


def _check_unit(where: str, value: tuple[float, ...]) -> None:
    length = math.hypot(*value)
    # The same: the length of NaN is NaN.
    if not abs(length - 1.0) <= UNIT_TOLERANCE:
        raise wrong_value(where, list(value), f"of length 1, not {length:g}")


def _check_size(where: str, geom: Geom, extent: float) -> None:
    """Check the size of a geom. ``extent``: largest absolute vertex coordinate of its mesh."""
    if geom.shape == "mesh":
        scale = np.abs(geom.size)
        check_range(where, scale, MIN_MESH_SCALE, MAX_MESH_SCALE, "1")
        check_range(
            f"{where} times the vertices of {geom.mesh!r}",
            scale * extent,
            0.0,
            MAX_SIZE_M,
            "m",
        )
        return
    used = NUMBERS_OF_SIZE[geom.shape]
    check_range(where, geom.size[:used], *_SIZE)
    # Unused entries are 0, but reach MuJoCo all the same.
    check_range(where, geom.size[used:], 0.0, MAX_SIZE_M, "m")


def _check_inertial(where: str, inertial: LinkInertial) -> None:
    """Refuse an inertia that no body has: principal moments are positive, and none is larger than the others' sum."""
    xx, yy, zz, xy, xz, yz = inertial.inertia
    moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if moments[0] <= 0.0 or moments[2] > moments[:2].sum() * (1.0 + 1e-9):
        raise ValueError(
            f"{where}.inertia: no body has the principal moments {moments.round(6).tolist()} [kg m^2]; they must be "
            "positive, and none larger than the sum of the others."
        )


def _check_link(where: str, link: Link) -> None:
    low, high = link.range
    if not low < high:
        raise ValueError(f"{where}.range: {low:g} to {high:g} is empty.")
    _check_solid(f"{where}.geoms", link.geoms)
    for k, geom in enumerate(link.geoms):
        if geom.shape == "mesh" and geom.collide:
            raise ValueError(
                f"{where}.geoms[{k}]: a link collides as primitives, not as the mesh {geom.mesh!r}; set collide to "
                "false, and add boxes that collide."
            )


def _check_solid(where: str, geoms: tuple[Geom, ...]) -> None:
    """Refuse a moving body without a colliding geom, over whose volume its mass is spread."""
    if not any(geom.collide for geom in geoms):
        raise ValueError(f"{where}: none of the {len(geoms)} geoms collides.")


def _check_home(where: str, home: Home) -> None:
    x_min, y_min, x_max, y_max = home.floor
    if not (x_min < x_max and y_min < y_max):
        raise ValueError(
            f"{where}.floor: {list(home.floor)} is no area: x_min, y_min, x_max, y_max [m]."
        )
    check_name(f"{where}.floor_material", home.floor_material)
    for link, limit in home.open_limits:
        check_name(f"{where}.open_limits", link)
        check_range(f"{where}.open_limits[{link!r}]", limit, *_JOINT)


def _mesh_extent(name: str, mesh: Any) -> float:
    """Check the arrays of a mesh; returns the largest absolute coordinate of its vertices (V, 3)."""
    where = f"mesh {check_name('name of a mesh', name)!r}"
    vertices = np.asarray(mesh.vertices)
    faces = np.asarray(mesh.faces)
    if (
        vertices.ndim != 2
        or vertices.shape[1] != 3
        or vertices.dtype.kind != "f"
        or not len(vertices)
    ):
        raise ValueError(
            f"{where}: vertices must be numbers (V, 3), got {vertices.dtype} {vertices.shape}."
        )
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
        raise ValueError(
            f"{where}: faces must be whole numbers (F, 3), got {faces.dtype} {faces.shape}."
        )
    if faces.size and not (faces.min() >= 0 and faces.max() < len(vertices)):
        raise ValueError(
            f"{where}: faces name vertices that are not there ({len(vertices)} vertices)."
        )
    extent = float(np.abs(vertices).max())
    if not math.isfinite(extent):
        raise ValueError(f"{where}: vertices are not finite.")
    return extent
