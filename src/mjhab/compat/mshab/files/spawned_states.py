"""Spawn entries of task plans and states of mjhab: each is made from the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjhab.compat.mshab.files.matching import (
    articulation_of,
    furniture_of,
    object_name,
)
from mjhab.compat.mshab.files.spawn_data import (
    ARTICULATION_QPOS,
    HELD_POSE,
    OBJ_POSE,
    PLACED_POSE,
    ROBOT_POS,
    ROBOT_QPOS,
    Spawns,
)
from mjhab.compat.mshab.files.subtasks import MsHabSubtask
from mjhab.core.errors import wrong_value
from mjhab.core.rotations import pose_inv, pose_mul, quat_from_yaw
from mjhab.data.imports.ms_hab_layout import object_id
from mjhab.episodes.episode import Episode
from mjhab.episodes.starts import StartMaker

_SLACK = 0.05
"""How far a joint position of a file may be out of the joint's range [m or rad]; it is then put to its end."""
_SAME = 1e-9
"""Largest difference of numbers that count as unchanged [m, rad]."""
_XY = slice(0, 2)


@dataclass(frozen=True, eq=False)
class SpawnedStates:
    """Turns spawn entries into states (nq,) of a layout, and back. Several threads may use it."""

    starts: StartMaker

    # -- from a file ---------------------------------------------------------------------------------------------------

    def state(
        self, episode: Episode, subtask: MsHabSubtask, entry: Spawns, number: int
    ) -> np.ndarray:
        """The state (nq,) of one spawn of a subtask.

        Args:
            episode: the episode before the robot's spawn.
            subtask: of the task plan.
            entry: its spawns.
            number: of the spawn in the entry.

        Raises:
            FieldError: the layout has no such object or furniture, or not as many joints.
        """
        qpos = self.starts.episode_qpos(episode)
        self._set_links(qpos, subtask, entry, number)
        # The entry stays as it was read: other starts are made from it.
        robot = entry[ROBOT_QPOS][number].copy()
        robot[_XY] += entry[ROBOT_POS][number][_XY]
        qpos[self.starts.sim.addresses.robot_q] = robot
        obj = object_name(getattr(subtask, "obj_id", None))
        if OBJ_POSE in entry and obj:
            self._put(qpos, obj, entry[OBJ_POSE][number])
        held = entry[HELD_POSE][number] if HELD_POSE in entry else np.zeros(7)
        # A pose of zeros alone stands for an empty hand.
        if obj and held.any():
            tcp = self.starts.sampler.scratch.tcp_pose(episode.home, qpos)
            self._put(qpos, obj, pose_mul(tcp, _unit(held)))
        removed = object_name(getattr(subtask, "remove_obj_id", None))
        if removed:
            slot = self._slot(removed)
            if PLACED_POSE in entry:
                self._put(qpos, removed, entry[PLACED_POSE][number])
            else:
                layout = self.starts.layout
                qpos[self._columns(slot)] = layout.parked_poses[slot]
        return qpos

    def _set_links(
        self, qpos: np.ndarray, subtask: MsHabSubtask, entry: Spawns, number: int
    ) -> None:
        config = articulation_of(subtask)
        if ARTICULATION_QPOS not in entry or config is None:
            return
        given = entry[ARTICULATION_QPOS][number]
        columns = self._link_rows(furniture_of(config))
        if len(given) != len(columns):
            if len(given) == 1 and given[0] == 0.0:
                return  # nothing is open
            raise wrong_value(
                f"joints of {furniture_of(config)!r} in {ARTICULATION_QPOS}",
                len(given),
                f"{len(columns)}, as in this pack",
            )
        layout = self.starts.layout
        for row, position in zip(columns, given.tolist(), strict=True):
            link = layout.links[row].link
            low, high = link.range
            # In the files a mirrored door opens to the other sign.
            own = -position if link.mirrored else position
            if not low - _SLACK <= own <= high + _SLACK:
                raise wrong_value(
                    f"{ARTICULATION_QPOS} of {layout.link_ids[row]}",
                    position,
                    f"from {low:g} to {high:g}",
                )
            qpos[self.starts.sim.addresses.link_q[row]] = min(max(own, low), high)

    def _put(self, qpos: np.ndarray, obj: str, pose: np.ndarray) -> None:
        """Put an object, whose pose is in the axes of its scan."""
        slot = self._slot(obj)
        qpos[self._columns(slot)] = pose_mul(_unit(pose), self._scan(slot, -1.0))

    # -- to a file -----------------------------------------------------------------------------------------------------

    def entry(self, episode: Episode, subtask: MsHabSubtask, qpos: np.ndarray) -> Spawns:
        """The spawn entry, of one spawn, with which `state` gives a state of an episode again.

        Args:
            episode: the episode before the robot's spawn.
            subtask: of the task plan.
            qpos: (nq,) the state in which the subtask starts.

        Raises:
            FieldError: something else differs from the episode than a spawn entry can tell.
        """
        a = self.starts.sim.addresses
        layout = self.starts.layout
        robot = qpos[a.robot_q].copy()
        place = np.array([*robot[_XY], layout.robot.base_height])
        robot[_XY] = 0.0
        found = {ROBOT_POS: place, ROBOT_QPOS: robot}
        config = articulation_of(subtask)
        moved = np.abs(qpos[a.link_q] - episode.link_q) > _SAME
        if moved.any():
            rows = self._link_rows(furniture_of(config)) if config else []
            _expect(set(np.flatnonzero(moved)) <= set(rows), "links", layout.link_ids)
            signs = [-1.0 if layout.links[row].link.mirrored else 1.0 for row in rows]
            found[ARTICULATION_QPOS] = qpos[a.link_q][rows] * signs
        obj = object_name(getattr(subtask, "obj_id", None))
        removed = object_name(getattr(subtask, "remove_obj_id", None))
        poses = qpos[a.object_q[:, None] + np.arange(7)]
        changed = np.abs(poses - episode.object_pose).max(axis=1) > _SAME
        for slot in np.flatnonzero(changed).tolist():
            name = layout.object_names[slot]
            pose = pose_mul(poses[slot], self._scan(slot, 1.0))
            if name == removed:
                found[PLACED_POSE] = pose
            elif name == obj and subtask.type in ("place", "navigate"):
                tcp = self.starts.sampler.scratch.tcp_pose(episode.home, qpos)
                found[HELD_POSE] = pose_mul(pose_inv(tcp), pose)
            else:
                _expect(name == obj, "objects", [object_id(name)])
                found[OBJ_POSE] = pose
        return {name: np.array([value]) for name, value in found.items()}

    # -- the layout ----------------------------------------------------------------------------------------------------

    def _slot(self, obj: str) -> int:
        names = self.starts.layout.object_names
        if obj not in names:
            raise wrong_value("obj_id", object_id(obj), "an object of the episode")
        return names.index(obj)

    def _columns(self, slot: int) -> np.ndarray:
        return self.starts.sim.addresses.object_q[slot] + np.arange(7)

    def _scan(self, slot: int, sign: float) -> np.ndarray:
        """Pose (7,) that turns an object by ``sign`` times the heading of its scan."""
        yaw = sign * self.starts.layout.objects[slot].scan_yaw
        return np.concatenate([np.zeros(3), quat_from_yaw(np.asarray(yaw))])

    def _link_rows(self, furniture: str) -> list[int]:
        links = self.starts.layout.links
        return [row for row, ref in enumerate(links) if ref.articulation == furniture]


def _unit(pose: np.ndarray) -> np.ndarray:
    """A pose (7,) of a file of float32, with its quaternion made a unit one."""
    length = float(np.linalg.norm(pose[3:]))
    # Rounding to float32 is off by far less, so such a pose is damaged.
    if not 0.9 < length < 1.1:
        raise wrong_value("quaternion of a pose", pose[3:].tolist(), "of length 1")
    return np.concatenate([pose[:3], pose[3:] / length])


def _expect(fits: bool, what: str, names: object) -> None:
    if not fits:
        raise wrong_value(
            f"{what} that a start changes",
            names,
            "those of the subtask: a spawn entry tells of no others",
        )
