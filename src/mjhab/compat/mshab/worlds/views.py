"""What scripts read of the robot, the objects and the furniture: poses and joints, float32 (W, ...)."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import torch

from mjhab.compat.mshab.worlds.observing import as_tensor
from mjhab.compat.mshab.worlds.pose import PoseBatch
from mjhab.core.arrays import namespace
from mjhab.core.conventions.changes import to_scan_axes
from mjhab.core.joints import BASE_XY, BASE_YAW
from mjhab.core.rotations import quat_from_yaw
from mjhab.data.imports.ms_hab_layout import object_id
from mjhab.envs.loop import TaskLoop


class View:
    """A part of the worlds that can be looked at. What is not answered says so."""

    def __getattr__(self, name: str) -> Any:
        known = sorted(n for n in dir(type(self)) if not n.startswith("_"))
        raise AttributeError(
            f"mjhab answers {', '.join(known)} of ManiSkill's {type(self).__name__.removesuffix('View')}, "
            f"and not {name!r}."
        )


def single(values: Any) -> torch.Tensor:
    """A float32 copy of an array."""
    # Without a copy float32 state would be shared, and change with the next step.
    return as_tensor(values).to(torch.float32, copy=True)


@dataclass(frozen=True)
class Entity:
    """One world's object or piece of furniture: its name, as in ``env-3_024_bowl-0``."""

    name: str


class LinkView(View):
    """A link of the robot."""

    def __init__(self, name: str, pose: Any) -> None:
        self.name = name
        self._pose = pose

    @property
    def pose(self) -> PoseBatch:
        """World pose."""
        return self._pose()


class RobotView(View):
    """Joints of the robot in MS-HAB's order: base (world x, y [m], yaw [rad]), torso, head and arm, fingers."""

    def __init__(self, worlds: TaskLoop) -> None:
        self._worlds = worlds

    @property
    def name(self) -> str:
        """Name of the robot."""
        return self._worlds.layout.robot.name

    @property
    def qpos(self) -> torch.Tensor:
        """(W, 15) positions."""
        return single(self._worlds.state.robot_q)

    @property
    def qvel(self) -> torch.Tensor:
        """(W, 15) velocities."""
        return single(self._worlds.state.robot_qd)

    def get_qpos(self) -> torch.Tensor:
        """(W, 15) positions."""
        return self.qpos

    def get_qvel(self) -> torch.Tensor:
        """(W, 15) velocities."""
        return self.qvel


class AgentView(View):
    """The robot: joints, hand, base."""

    uid = "fetch"

    def __init__(self, worlds: TaskLoop, control_mode: str) -> None:
        self._worlds = worlds
        self.control_mode = control_mode
        self.robot = RobotView(worlds)
        self.tcp = LinkView("gripper_link", self._hand)
        self.base_link = LinkView("base_link", self._base)
        rest = worlds.layout.robot.rest_qpos
        self.keyframes = {"rest": SimpleNamespace(qpos=torch.tensor(rest).numpy())}

    @property
    def tcp_pose(self) -> PoseBatch:
        """World pose of the point between the fingers, with the axes of the hand."""
        worlds = self._worlds
        left, right = (
            worlds.state.body_pos[:, worlds.sim.addresses.robot_body[finger]]
            for finger in worlds.layout.robot.finger_links
        )
        pose = self._hand().raw_pose
        pose[:, :3] = single((left + right) / 2)
        return PoseBatch(pose)

    def is_grasping(self, object: Any = None, **_: Any) -> torch.Tensor:
        """(W,) bool: the target of the active subtask is held; of no other object it is known."""
        signals = self._worlds.signals
        assert signals is not None
        held = as_tensor(signals.is_grasped)
        at = getattr(object, "subtask_num", None)
        if at is None:
            return held.clone()
        return held & (as_tensor(self._worlds.progress.pointer) == at)

    def is_static(self, *_: Any, **__: Any) -> torch.Tensor:
        """(W,) bool: base, torso, head and arm stand still, by the thresholds of success."""
        signals = self._worlds.signals
        assert signals is not None
        return as_tensor(signals.is_static).clone()

    def _hand(self) -> PoseBatch:
        return PoseBatch(single(self._worlds.sensing.tcp_pose(self._worlds.state)))

    def _base(self) -> PoseBatch:
        base = self._worlds.state.robot_q
        xp = namespace(base)
        height = xp.zeros_like(base[:, :1]) + self._worlds.layout.robot.base_height
        quat = quat_from_yaw(base[:, BASE_YAW])
        return PoseBatch(single(xp.concat([base[:, BASE_XY], height, quat], axis=1)))


class ObjectView(View):
    """The object of one subtask in every world, in the axes of its scan.

    Args:
        worlds: the worlds. number: place of the subtask in the plans.
    """

    def __init__(self, worlds: TaskLoop, number: int) -> None:
        self._worlds = worlds
        self.subtask_num = number
        self.name = f"obj_{number}"

    @property
    def pose(self) -> PoseBatch:
        """World pose."""
        worlds = self._worlds
        state = worlds.state
        slots = as_tensor(worlds.tables.obj)[:, self.subtask_num].long()
        poses = single(state.object_pose)
        rows = torch.arange(len(poses), device=poses.device)
        yaws = torch.tensor(
            [kind.scan_yaw for kind in worlds.layout.objects], device=poses.device
        )
        return PoseBatch(to_scan_axes(poses[rows, slots], yaws[slots]))

    @property
    def _objs(self) -> list[Entity]:
        names = self._worlds.layout.object_names
        slots = as_tensor(self._worlds.tables.obj)[:, self.subtask_num].tolist()
        return [
            Entity(f"env-{w}_{object_id(names[slot])}") for w, slot in enumerate(slots)
        ]


class GoalView(View):
    """Where a subtask leads in every world: goal of a Place, handle, end of a way."""

    def __init__(self, worlds: TaskLoop, number: int) -> None:
        self._worlds = worlds
        self.subtask_num = number
        self.name = f"goal_{number}"

    @property
    def pose(self) -> PoseBatch:
        """World pose; only the position means something."""
        goals = self._worlds.tables.arrays.goal_pos[:, self.subtask_num]
        return PoseBatch.create_from_pq(p=single(goals), device=as_tensor(goals).device)


class ArticulationView(View):
    """The piece of furniture with the drawer or door of a subtask in every world."""

    def __init__(self, worlds: TaskLoop, number: int) -> None:
        self._worlds = worlds
        self.subtask_num = number
        self.name = f"articulation-{number}"

    @property
    def _links(self) -> torch.Tensor:
        return as_tensor(self._worlds.tables.link)[:, self.subtask_num].long()

    @property
    def handle_qpos(self) -> torch.Tensor:
        """(W,) position of the subtask's own joint [m or rad]."""
        positions = single(self._worlds.state.link_q)
        return positions.gather(1, self._links[:, None])[:, 0]

    @property
    def _objs(self) -> list[Entity]:
        links = self._worlds.layout.links
        return [
            Entity(f"env-{world}_{links[at].articulation}-0")
            for world, at in enumerate(self._links.tolist())
        ]
