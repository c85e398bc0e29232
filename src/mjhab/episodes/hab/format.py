"""Files of rearrangement episodes in the format of the Home Assistant Benchmark: reader, writer and frames.

The format is that of habitat-lab (habitat/datasets/rearrange/rearrange_dataset.py): JSON, or gzipped JSON, with a list
``episodes``. Poses are 4x4 matrices, row by row, in a world frame with +y up. Writing what was read gives the same
content.
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Iterable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.core.errors import about, missing_field, wrong_type, wrong_value
from mjhab.core.files.cache import write_atomic
from mjhab.core.files.reading import read_json
from mjhab.core.names import check_name, copy_names
from mjhab.core.rotations import mat_from_quat, pose_mul, quat_from_mat, quat_from_yaw
from mjhab.core.typed.checks import check
from mjhab.scenes.pack_check import MAX_JOINT_POSITION, MAX_POSITION_M, check_range

OBJECT_SUFFIX = ".object_config.json"
SCENE_SUFFIX = ".scene_instance.json"
MAX_OBJECTS = 300
"""Most objects of an episode, and of the roster of a file; published episodes have up to 30."""
DECIMALS = 6
"""Decimals of the entries of written matrices: 1 micrometre."""
ROUND_TRIP = 1e-3
"""Largest deviation of R R^T from the identity in a file; published files have five digits."""
UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Rotation (3, 3) from HAB's world frame (+y up) to mjhab's (+z up): a quarter turn about x."""

Receptacle = tuple[str, int | None]
"""(furniture handle, link number or None) of a receptacle."""


@dataclass(frozen=True)
class Marker:
    """A named point on a link, such as a handle. ``offset`` [m] is in the link frame with +y up."""

    name: str
    object: str
    link: str
    offset: tuple[float, float, float]
    type: str = "articulated_object"


@dataclass(frozen=True, eq=False)
class HabEpisode:
    """One episode of a file; the world frame has +y up.

    Attributes:
        episode_id: id of the episode.
        scene_id: path of the scene.
        rigid_objs: (file name of the object type, pose (4, 4)) of every object.
        targets: goal pose (4, 4) by instance name, e.g. "003_cracker_box_:0000".
        ao_states: joint positions [m or rad] by furniture handle and link number (or link name).
        markers: named points on links.
        target_receptacles: (handle, link number) of the start of each target; may be empty.
        goal_receptacles: (handle, link number) of the goal of each target; may be empty.
        name_to_receptacle: receptacle id by instance name.
        info: free data; its ``object_labels`` give the order of the targets.
        rest: all other fields of the file, unchanged.
    """

    episode_id: str
    scene_id: str
    rigid_objs: tuple[tuple[str, np.ndarray], ...]
    targets: dict[str, np.ndarray]
    ao_states: dict[str, dict[str, float]] = field(default_factory=dict)
    markers: tuple[Marker, ...] = ()
    target_receptacles: tuple[Receptacle, ...] = ()
    goal_receptacles: tuple[Receptacle, ...] = ()
    name_to_receptacle: dict[str, str] = field(default_factory=dict)
    info: dict[str, Any] = field(default_factory=dict)
    rest: dict[str, Any] = field(default_factory=dict)

    @property
    def scene(self) -> str:
        """Name of the scene: the file name of ``scene_id`` without its suffix."""
        return (
            self.scene_id.replace("\\", "/").rsplit("/", 1)[-1].removesuffix(SCENE_SUFFIX)
        )

    @property
    def types(self) -> tuple[str, ...]:
        """Object type of every rigid object."""
        return tuple(
            name.replace("\\", "/").rsplit("/", 1)[-1].removesuffix(OBJECT_SUFFIX)
            for name, _ in self.rigid_objs
        )

    @property
    def instances(self) -> tuple[str, ...]:
        """Instance name of every rigid object: type and number among the objects of that type."""
        return copy_names(self.types)

    @property
    def target_names(self) -> tuple[str, ...]:
        """Instance names of the targets, in order."""
        labels = self.info.get("object_labels") or {}
        # The order of the labels is that of the task; objects of JSON keep theirs, but writers of targets need not.
        return tuple(name for name in labels if name in self.targets) or tuple(
            self.targets
        )


@dataclass(frozen=True, eq=False)
class HabFile:
    """The episodes of a file. ``rest``: its other fields, unchanged; ``path``: the file, for messages."""

    episodes: tuple[HabEpisode, ...]
    rest: dict[str, Any] = field(default_factory=dict)
    path: Path = Path("episodes")


# -- files -------------------------------------------------------------------------------------------------------------


def read_hab(path: Path) -> HabFile:
    """Read a file ``*.json`` or ``*.json.gz``.

    Raises:
        UsageError: there is no such file, it is cut off or not JSON, a field is missing or has the wrong type, a name
            is invalid, or an object is farther than `MAX_POSITION_M` from the origin; names file and field.
    """
    body = read_json(path)
    if not isinstance(body, dict) or not isinstance(body.get("episodes"), list):
        advice = "This is no file of rearrangement episodes."
        raise wrong_value("episodes", body, "a list", advice, where=path)
    check(len(body["episodes"]) > 0, "episodes", [], "a list of one or more", where=path)
    with about(path):
        episodes = tuple(
            _episode(row, f"episodes[{i}]") for i, row in enumerate(body["episodes"])
        )
    return HabFile(
        episodes, {key: value for key, value in body.items() if key != "episodes"}, path
    )


def write_hab(path: Path, file: HabFile) -> None:
    """Write a file atomically, gzipped if its name ends with ``.gz``."""
    write_rows(
        path,
        file.rest,
        (json.dumps(to_json(episode), allow_nan=False) for episode in file.episodes),
    )


def write_rows(path: Path, rest: Mapping[str, Any], rows: Iterable[str]) -> None:
    """Write a file as `write_hab` does, from its other fields ``rest`` and episodes ``rows`` as JSON text."""

    # Row by row, so that the text of all episodes is never in memory at once.
    head = json.dumps({**rest, "episodes": []}, allow_nan=False).removesuffix("]}")

    def write(temporary: Path) -> None:
        with temporary.open("wb") as raw, _compressed(raw, path) as stream:
            stream.write(head.encode())
            for k, row in enumerate(rows):
                stream.write((", " if k else "").encode() + row.encode())
            stream.write(b"]}")

    write_atomic(path, write)


def _compressed(raw: Any, path: Path) -> Any:
    # No name and no time stamp: the same episodes give the same bytes.
    return (
        gzip.GzipFile("", "wb", fileobj=raw, mtime=0)
        if path.suffix == ".gz"
        else nullcontext(raw)
    )


def to_json(episode: HabEpisode) -> dict[str, Any]:
    """Return an episode as the JSON object of the format."""
    return {
        "episode_id": episode.episode_id,
        "scene_id": episode.scene_id,
        **episode.rest,
        "info": episode.info,
        "ao_states": episode.ao_states,
        "rigid_objs": [[name, matrix.tolist()] for name, matrix in episode.rigid_objs],
        "targets": {name: matrix.tolist() for name, matrix in episode.targets.items()},
        "markers": [
            {
                "name": m.name,
                "type": m.type,
                "params": {"offset": list(m.offset), "link": m.link, "object": m.object},
            }
            for m in episode.markers
        ],
        "target_receptacles": [list(pair) for pair in episode.target_receptacles],
        "goal_receptacles": [list(pair) for pair in episode.goal_receptacles],
        "name_to_receptacle": episode.name_to_receptacle,
    }


_FIELDS = (
    "episode_id",
    "scene_id",
    "rigid_objs",
    "targets",
    "ao_states",
    "markers",
    "target_receptacles",
    "goal_receptacles",
    "name_to_receptacle",
    "info",
)


def from_json(row: Mapping[str, Any]) -> HabEpisode:
    """Return the episode of a JSON object; inverse of `to_json`.

    Raises:
        UsageError: a field is missing or has the wrong type.
    """
    return _episode(row, "episode")


def _episode(row: Any, where: str) -> HabEpisode:
    if not isinstance(row, Mapping):
        raise wrong_type(where, row, "an object")
    for name in ("scene_id", "rigid_objs", "targets"):
        if name not in row:
            raise missing_field(name, where)

    def fitting(name: str, kind: type, default: Any) -> Any:
        value = row.get(name, default)
        # Some writers state an empty field as null.
        if value is None and default is not None:
            return default
        if not isinstance(value, kind):
            raise wrong_type(f"{where}.{name}", value, f"a {kind.__name__}")
        return value

    objects = fitting("rigid_objs", list, None)
    targets = fitting("targets", dict, None)
    for name, found in (("rigid_objs", objects), ("targets", targets)):
        # Checked before the matrices are read: a file from elsewhere must not exhaust memory.
        if len(found) > MAX_OBJECTS:
            raise wrong_value(
                f"number of {where}.{name}",
                len(found),
                f"at most {MAX_OBJECTS:,}: more cannot be simulated",
            )
    info = fitting("info", dict, {})
    if not isinstance(info.get("object_labels", {}), dict):
        raise wrong_type(
            f"{where}.info.object_labels", info["object_labels"], "an object"
        )
    episode = HabEpisode(
        episode_id=str(row.get("episode_id", "")),
        scene_id=fitting("scene_id", str, None),
        rigid_objs=tuple(
            _rigid(entry, f"{where}.rigid_objs[{i}]") for i, entry in enumerate(objects)
        ),
        targets={
            name: _matrix(value, f"{where}.targets[{name!r}]")
            for name, value in targets.items()
        },
        ao_states=_states(fitting("ao_states", dict, {}), f"{where}.ao_states"),
        markers=tuple(
            _marker(m, f"{where}.markers[{i}]")
            for i, m in enumerate(fitting("markers", list, []))
        ),
        target_receptacles=_receptacles(
            fitting("target_receptacles", list, []), f"{where}.target_receptacles"
        ),
        goal_receptacles=_receptacles(
            fitting("goal_receptacles", list, []), f"{where}.goal_receptacles"
        ),
        name_to_receptacle=fitting("name_to_receptacle", dict, {}),
        info=info,
        rest={key: value for key, value in row.items() if key not in _FIELDS},
    )
    _check_names(episode, where)
    return episode


def _check_names(episode: HabEpisode, where: str) -> None:
    check_name(f"{where}.scene_id", episode.scene)
    for i, kind in enumerate(episode.types):
        check_name(f"{where}.rigid_objs[{i}]", kind)
    for field_name in ("targets", "ao_states", "name_to_receptacle"):
        for name in getattr(episode, field_name):
            check_name(f"{where}.{field_name}", name)
    for handle, joints in episode.ao_states.items():
        for link in joints:
            check_name(f"{where}.ao_states[{handle!r}]", link)
    for field_name in ("target_receptacles", "goal_receptacles"):
        for i, (handle, _) in enumerate(getattr(episode, field_name)):
            check_name(f"{where}.{field_name}[{i}]", handle, empty=True)
    for marker in episode.markers:
        for name in (marker.name, marker.object, marker.link):
            check_name(f"{where}.markers", name)
    for name, receptacle in episode.name_to_receptacle.items():
        # "<handle>|<receptacle>"
        for part in str(receptacle).split("|"):
            check_name(f"{where}.name_to_receptacle[{name!r}]", part, empty=True)


def _matrix(value: Any, where: str) -> np.ndarray:
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        # Of no valid shape, so that one message serves for all that can be wrong.
        matrix = np.zeros(0)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise wrong_value(where, value, "a 4x4 matrix of finite numbers")
    check_range(f"{where}.position", matrix[:3, 3], -MAX_POSITION_M, MAX_POSITION_M, "m")
    rotation = matrix[:3, :3]
    check_range(f"{where}.rotation", rotation, -2.0, 2.0, "1")
    if (
        np.abs(rotation @ rotation.T - np.eye(3)).max() > ROUND_TRIP
        # A mirror image passes the test of orthogonality.
        or np.linalg.det(rotation) < 0
    ):
        raise wrong_value(where, value, "a pose whose upper left 3x3 part is a rotation")
    return matrix


def _rigid(entry: Any, where: str) -> tuple[str, np.ndarray]:
    if not isinstance(entry, list) or len(entry) != 2 or not isinstance(entry[0], str):
        raise wrong_value(where, entry, "[file name, 4x4 matrix]")
    return entry[0], _matrix(entry[1], f"{where}[1]")


def _states(value: dict[str, Any], where: str) -> dict[str, dict[str, float]]:
    out: dict[str, dict[str, float]] = {}
    for handle, joints in value.items():
        if not isinstance(joints, dict):
            raise wrong_value(
                f"{where}[{handle!r}]",
                joints,
                "an object of link number and joint position",
            )
        for number, position in joints.items():
            if (
                # In Python a bool is an int.
                isinstance(position, bool)
                or not isinstance(position, int | float)
                # Negated, so that NaN is refused as well.
                or not abs(position) <= MAX_JOINT_POSITION
            ):
                raise wrong_value(
                    f"{where}[{handle!r}][{number!r}]", position, "a number"
                )
        out[handle] = dict(joints)
    return out


def _marker(value: Any, where: str) -> Marker:
    try:
        params = value["params"]
        x, y, z = (float(v) for v in params["offset"])
        marker = Marker(
            str(value["name"]),
            str(params["object"]),
            str(params["link"]),
            (x, y, z),
            str(value["type"]),
        )
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        expected = "an object with name, type and params with offset, link and object"
        raise wrong_value(where, value, expected) from error
    check_range(
        f"{where}.params.offset", marker.offset, -MAX_POSITION_M, MAX_POSITION_M, "m"
    )
    return marker


def _receptacles(value: list[Any], where: str) -> tuple[Receptacle, ...]:
    out: list[Receptacle] = []
    for i, entry in enumerate(value):
        fits = isinstance(entry, list) and len(entry) == 2 and isinstance(entry[0], str)
        if not fits or not (entry[1] is None or isinstance(entry[1], int)):
            raise wrong_value(f"{where}[{i}]", entry, "[handle, link number or null]")
        out.append((entry[0], entry[1]))
    return tuple(out)


# -- frames ------------------------------------------------------------------------------------------------------------


def pose_from_hab(matrix: np.ndarray, scan_yaw: float = 0.0) -> np.ndarray:
    """Convert an object pose of a file to a pose (7,) [m, wxyz] in mjhab's world frame (+z up).

    Args:
        matrix: (4, 4) pose; world and object frames with +y up.
        scan_yaw: yaw [rad] of the file's object frame in mjhab's (`ObjectType.scan_yaw`).
    """
    rotation = UP @ matrix[:3, :3] @ UP.T
    u, _, v = np.linalg.svd(rotation)  # the nearest rotation: files give few digits
    pose = np.concatenate([UP @ matrix[:3, 3], quat_from_mat(u @ v)])
    return pose_mul(pose, _turned(-scan_yaw))


def pose_to_hab(pose: np.ndarray, scan_yaw: float = 0.0) -> np.ndarray:
    """Convert a pose (7,) [m, wxyz] to the (4, 4) matrix of a file, with `DECIMALS`; inverse of `pose_from_hab`."""
    scan = pose_mul(np.asarray(pose, np.float64), _turned(scan_yaw))
    matrix = np.eye(4)
    matrix[:3, :3] = UP.T @ mat_from_quat(scan[3:]) @ UP
    matrix[:3, 3] = UP.T @ scan[:3]
    # A rounded pose is the same text on every machine.
    return np.round(matrix, DECIMALS) + 0.0  # no minus zeros


def _turned(yaw: float) -> np.ndarray:
    return np.concatenate([np.zeros(3), quat_from_yaw(np.asarray(yaw))])
