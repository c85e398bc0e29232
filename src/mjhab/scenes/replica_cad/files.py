"""Layout of a ReplicaCAD folder, checked reading of its JSON, and conversion of its axes.

The data set is right-handed with +y up; our +z is up. Vectors of the data set are converted by a rotation of 90 deg
about x: (x, y, z) -> (x, -z, y).
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.core.errors import about, fault, shown, wrong_value
from mjhab.core.files.reading import beside, read_json_object
from mjhab.core.names import check_name
from mjhab.core.rotations import mat_from_quat, quat_from_mat
from mjhab.core.typed.checks import check
from mjhab.scenes.formats.gltf import TO_Z_UP
from mjhab.scenes.pack_check import MAX_FILE_NUMBER
from mjhab.scenes.spec import Placement, Quat, Vec3

SCENE_SUFFIX = ".scene_instance.json"
PREFIX = "frl_apartment_"
"""Prefix of most names in the data set, which our names lack."""
FOLDERS = ("configs/scenes", "configs/objects", "objects", "urdf")
NAVMESHES = "navmeshes_default"
"""Folder of the scenes' navigation meshes for an agent of radius `walkable.AGENT_RADIUS_M`."""
HOW_TO_GET = "`mjhab assets fetch replica_cad` gets it"
_MIN_QUATERNION_LENGTH = 0.5
_MAX_LEVEL_TILT_RAD = 1e-4
"""Rotations that tilt the vertical axis by less than about this [rad] are stored as a heading only."""


def is_replica_cad(folder: Path) -> bool:
    """Whether a folder looks like the data set, complete or not."""
    # An incomplete data set must be recognised as well, so that the message says what is missing.
    return any((folder / name).is_dir() for name in FOLDERS[:2]) or (
        (folder / "replicaCAD.scene_dataset_config.json").is_file()
    )


def check_folder(folder: Path) -> None:
    """Check that a data set folder is complete.

    Raises:
        UsageError: folders are missing; the message names them.
    """
    missing = [name for name in FOLDERS if not (folder / name).is_dir()]
    if missing:
        raise fault(
            folder,
            f"not a whole ReplicaCAD data set: {', '.join(missing)} missing; {HOW_TO_GET}.",
        )


def file_state(path: Path) -> tuple[int, int]:
    """Size [bytes] and modification time [ns] of a file, by which what was read of it is known; zeros without one."""
    try:
        stat = path.stat()
    except OSError:
        return 0, 0
    return stat.st_size, stat.st_mtime_ns


def load_json(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        UsageError: the file is missing, cut off or not an object; the message names it.
    """
    if not path.exists():
        raise fault(path, f"cannot be read (there is no such file); {HOW_TO_GET}.")
    return read_json_object(path)


def field(path: Path, record: Any, key: str, where: str = "") -> Any:
    """``record[key]``, or a UsageError that names the file and the field."""
    if not isinstance(record, dict) or key not in record:
        raise fault(path, f"field {(f'{where}.{key}' if where else key)!r} is missing.")
    return record[key]


def numbers(path: Path, record: Any, key: str, count: int, where: str = "") -> np.ndarray:
    """A list of ``count`` numbers of a record, none beyond `MAX_FILE_NUMBER`, or a UsageError that names the field."""
    value = field(path, record, key, where)
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError, OverflowError):
        array = np.zeros(0)
    if array.shape != (count,) or not (np.abs(array) <= MAX_FILE_NUMBER).all():
        expected = (
            f"expected {count} numbers, got {shown(value)} (up to {MAX_FILE_NUMBER:g})"
        )
        raise fault(path, f"field {where}.{key}: {expected}.")
    return array


def number(
    path: Path, record: Any, key: str, where: str = "", *, positive: bool = False
) -> float:
    """A number of a record, not beyond `MAX_FILE_NUMBER`, or a UsageError that names the file and the field."""
    found = float(
        numbers(path, {key: [field(path, record, key, where)]}, key, 1, where)[0]
    )
    check(
        not positive or found > 0.0,
        f"{where}.{key}",
        found,
        "a number above 0",
        where=path,
    )
    return found


def file_in(path: Path, record: Any, key: str) -> Path:
    """Return the path that a field of a config names relative to the config's folder; it need not exist.

    Raises:
        UsageError: the field is missing or no path; the message names it.
    """
    value = field(path, record, key)
    if not isinstance(value, str):
        raise wrong_value(key, value, "the name of a file", where=path)
    with about(f"{path}: field {key!r}"):
        return beside(path, value).resolve()


def short_name(template: str) -> str:
    """Return our name of a template: without folder and without `PREFIX`."""
    return template.rsplit("/", 1)[-1].removeprefix(PREFIX)


def point(row: np.ndarray) -> Vec3:
    """Convert a row (3,) to a tuple of floats."""
    x, y, z = np.asarray(row, float).tolist()
    return (x, y, z)


def quat_of(rotation: np.ndarray) -> Quat:
    """Convert a rotation matrix (3, 3) to a quaternion wxyz, as a tuple of floats."""
    w, x, y, z = quat_from_mat(np.asarray(rotation, float)).tolist()
    return (w, x, y, z)


def rotation(path: Path, record: dict[str, Any], where: str) -> np.ndarray:
    """Read the rotation (3, 3) of a record, in the axes of the data set; the identity if it has none.

    Raises:
        UsageError: the field is no quaternion.
    """
    if "rotation" not in record:
        return np.eye(3)
    given = numbers(path, record, "rotation", 4, where)
    # Files have few digits, so that lengths differ from 1 a little; near 0 there is no direction.
    if np.linalg.norm(given, axis=-1) < _MIN_QUATERNION_LENGTH:
        raise fault(path, f"field {where}.rotation: not a quaternion: {given.tolist()}.")
    return mat_from_quat(given / np.linalg.norm(given, axis=-1))


def placement(path: Path, record: dict[str, Any], template: str, where: str) -> Placement:
    """Read the placement of a template from a scene's record, converted to our axes.

    Raises:
        UsageError: a field is missing or of the wrong type; the message names it.
    """
    x, y, z = numbers(path, record, "translation", 3, where).tolist()
    turn = TO_Z_UP @ rotation(path, record, where) @ TO_Z_UP.T
    return place(template, np.array([x, -z, y]), turn)


def place(template: str, pos: np.ndarray, rotation: np.ndarray) -> Placement:
    """Make a placement from a position (3,) [m] and a rotation (3, 3); without a quaternion if it is upright."""
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    tilted = (
        np.hypot(rotation[0, 2], rotation[1, 2]) > _MAX_LEVEL_TILT_RAD
        or rotation[2, 2] < 0
    )
    return Placement(template, point(pos), yaw, quat_of(rotation) if tilted else None)


def text(path: Path, record: Any, key: str, where: str) -> str:
    """Text of a field, or a UsageError that names the field."""
    value = field(path, record, key, where)
    if not isinstance(value, str):
        raise wrong_value(f"{where}.{key}", value, "a name", where=path)
    return value


def template(path: Path, record: Any, where: str) -> str:
    """Name of a template, with its folder if the record has one."""
    given = text(path, record, "template_name", where)
    with about(path):
        return check_name(f"field {where}.template_name", given)
