"""States and `info` of recorded episodes in ManiSkill's layout: what its trajectory files hold beside observations.

`env_states` are what ``get_state_dict`` of ManiSkill's environments gives (mani_skill/utils/structs): of an actor its
position [m], quaternion wxyz, velocity [m/s] and angular velocity [rad/s] in the world; of an articulation those of its
root, the positions of its joints, and their velocities. `infos` are what MS-HAB's environments tell of a step, under
their names, so that its labels (mshab/utils/label_dataset.py) can be made of the file.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from mjhab.core.arrays import Array, as_like, namespace
from mjhab.core.conventions.changes import to_scan_axes
from mjhab.core.names import kind_of
from mjhab.core.rotations import quat_rotate
from mjhab.data.imports.ms_hab_layout import (
    FINISHED,
    INFO_CHECKS,
    INFO_FORCES,
    JOINT,
    checks_of,
    object_id,
)
from mjhab.data.store.episode_data import RunInfo
from mjhab.data.store.reading import RecordedEpisode
from mjhab.data.store.run_entries import SCAN_YAWS
from mjhab.tasks.subtasks.registry import SUBTASKS, number_of

_POSE = 7
_SPEED = 6
_NEEDED = ("robot_q", "robot_v", "object_q", "object_v", "link_q")


@dataclass(frozen=True)
class JointNote:
    """A joint of a piece of furniture. sign: -1 where files count its position the other way. low, high [m or rad]."""

    sign: float = 1.0
    low: float = 0.0
    high: float = 1.0


@dataclass(frozen=True)
class Root:
    """World pose (7,) [m, wxyz] of the root of an articulation, and its joints by the names of their links."""

    pose: tuple[float, ...]
    joints: Mapping[str, JointNote] = field(default_factory=dict)


Roots = Callable[[RunInfo, str], Mapping[str, Root]]
"""The articulations of a home, those that are known, by name; the robot is one of them."""


def no_roots(run: RunInfo, home: str) -> Mapping[str, Root]:
    """For exports that know of no articulation where it stands."""
    return {}


def env_states(
    episode: RecordedEpisode, rows: int, roots: Mapping[str, Root]
) -> dict[str, np.ndarray]:
    """States by "actors/<name>" (rows, 13) and "articulations/<name>" (rows, 13 + 2 joints) float32.

    Objects are in the axes of their scans, furniture is named as in task plans. Empty for an episode without states.

    Args:
        episode: the episode.
        rows: number of its states that are wanted.
        roots: where articulations stand; others are left out.
    """
    layout = episode.run.layout
    columns = layout.get("columns", {})
    # Imported episodes have no states, and runs of older versions no columns.
    if "states/qpos" not in episode.paths or not set(_NEEDED) <= set(columns):
        return {}
    q = episode.array("states/qpos")[:rows]
    v = episode.array("states/qvel")[:rows]
    found = {}
    yaws = layout.get(SCAN_YAWS, {})
    free = zip(columns["object_q"], columns["object_v"], strict=True)
    for name, (at_q, at_v) in zip(layout["objects"], free, strict=True):
        pose = q[:, at_q : at_q + _POSE]
        yaw = float(yaws.get(kind_of(name), 0.0))
        state = actor_state(pose, v[:, at_v : at_v + _SPEED], yaw)
        found[f"actors/{object_id(name)}"] = state
    robot = episode.run.robot
    if robot in roots:
        joints = [q[:, columns["robot_q"]], v[:, columns["robot_v"]]]
        root = np.array(roots[robot].pose)
        found[f"articulations/{robot}"] = articulation_state(root, *joints)
    moving = _joints_of(layout["links"], columns)
    for name, joints in moving.items():
        if name in roots:
            notes = roots[name].joints
            signs = [notes.get(link, JointNote()).sign for link, _, _ in joints]
            at_q = [column for _, column, _ in joints]
            at_v = [column for _, _, column in joints]
            # The number is that of the copy in the scene; MS-HAB's scenes have one of each.
            found[f"articulations/{name}-0"] = articulation_state(
                np.array(roots[name].pose), q[:, at_q] * signs, v[:, at_v] * signs
            )
    # Computed in float64 and rounded once, as torch tensors of ManiSkill are float32.
    return {name: values.astype(np.float32) for name, values in found.items()}


def _joints_of(
    links: list[str], columns: Mapping[str, list[int]]
) -> dict[str, list[tuple[str, int, int]]]:
    """(link, column of qpos, column of qvel) of the joints of every piece of furniture."""
    found: dict[str, list[tuple[str, int, int]]] = {}
    for link, at in zip(links, columns["link_q"], strict=True):
        furniture, _, name = link.rpartition("/")
        # Free bodies before it have a number more in qpos than in qvel.
        before = sum(column < at for column in columns["object_q"])
        found.setdefault(furniture, []).append((name, at, at - before))
    return found


def actor_state(pose: Array, velocity: Array, scan_yaw: Array | float) -> Array:
    """State (..., 13) of an object as ManiSkill has it.

    Args:
        pose: (..., 7) world pose in mjhab's axes of the object [m, wxyz].
        velocity: (..., 6) of its origin in the world [m/s], then angular in the object's own frame [rad/s], as MuJoCo
            has those of free bodies.
        scan_yaw: (...) or one number, heading of the scan [rad].
    """
    # MuJoCo gives the angular velocity of a free joint in the body's frame, ManiSkill wants the world's.
    turning = quat_rotate(pose[..., 3:], velocity[..., 3:])
    parts = [to_scan_axes(pose, scan_yaw), velocity[..., :3], turning]
    return namespace(pose).concat(parts, axis=-1)


def articulation_state(root: Array, q: Array, v: Array) -> Array:
    """State (rows, 13 + 2 J) of an articulation whose root stands still.

    Args:
        root: (7,) or (rows, 7) world pose of the root [m, wxyz]. q, v: (rows, J) its joints.
    """
    xp = namespace(q)
    pose = xp.broadcast_to(as_like(root, q), (len(q), _POSE))
    return xp.concat([pose, xp.zeros_like(pose[:, :_SPEED]), q, v], axis=1)


def infos(
    episode: RecordedEpisode, rows: int, roots: Mapping[str, Root]
) -> dict[str, np.ndarray]:
    """`info` of the first ``rows`` states, (rows,) each; empty for an episode without signals.

    Entries of the joint are those of a single Open or Close whose furniture is known.
    """
    if "signals/checks" not in episode.paths:
        return {}
    record = episode.record
    pointer = episode.array("subtasks/active")[:rows].astype(np.int64)
    # The entry past the plan is what a finished world points at.
    kinds = np.array([number_of(entry.kind) for entry in record.plan] + [FINISHED])
    ended = [
        np.concatenate(
            # Outcomes belong to actions and info to states: state 0 has no action before it.
            [[False], episode.array(f"reward/{name}")[: rows - 1].astype(bool)]
        )
        for name in ("success", "fail")
    ]
    found = {
        "elapsed_steps": np.arange(rows, dtype=np.int32),
        "success": ended[0],
        "fail": ended[1],
        "subtask": pointer,
        "subtask_type": kinds[np.minimum(pointer, len(record.plan))],
    }
    forces = episode.table("signals/forces")
    for name, ours in INFO_FORCES.items():
        found[name] = forces[ours][:rows].astype(np.float32)
    checks = episode.table("signals/checks")
    for kind in dict.fromkeys(entry.kind for entry in record.plan):
        for name in checks_of(kind):
            found[name] = checks[INFO_CHECKS[name]][:rows].astype(bool)
    entry = record.plan[0]
    furniture, _, link = entry.target.rpartition("/")
    states = env_states(episode, rows, roots)
    name = f"articulations/{furniture}-0"
    if record.subtask and SUBTASKS[entry.kind].jointed and name in states:
        moving = _joints_of(episode.run.layout["links"], episode.run.layout["columns"])
        at = [other for other, _, _ in moving[furniture]].index(link)
        note = roots[furniture].joints[link]
        position = states[name][:, _POSE + _SPEED + at]
        # A flipped sign turns the upper end into the lower one.
        ends = sorted((note.sign * note.low, note.sign * note.high))
        values = (position, *(np.full(rows, end, np.float32) for end in ends))
        found |= dict(zip(JOINT, values, strict=True))
    return found
