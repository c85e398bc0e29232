"""Privileged information for scripted experts: the full state of a world and the shapes of its home."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from mjhab.core.boxes import Boxes
from mjhab.core.joints import BASE
from mjhab.core.memory_cache import MemoryCache
from mjhab.core.rotations import mat_from_quat, quat_from_axis_angle
from mjhab.envs.parts.worlds import PolicyWorlds
from mjhab.episodes.grasps.pinch import ObjectShape
from mjhab.episodes.grasps.stable import shape_of
from mjhab.layout.layout import Layout, compose
from mjhab.layout.receptacles import PlacedReceptacle, placed_receptacles
from mjhab.robots.robot import Robot
from mjhab.scenes.freespace import shared_map
from mjhab.scenes.shapes.hulls import boxed_hull
from mjhab.scenes.spec import (
    PUBLISHED_DYNAMICS,
    Geom,
    Handle,
    Home,
    Link,
    ObjectType,
    Pack,
    Placement,
)
from mjhab.tasks.plan import Subtask
from mjhab.tasks.thresholds import TaskConfig


@dataclass(frozen=True, eq=False)
class JointedLink:
    """A drawer or door of a home.

    Attributes:
        id: id of the link.
        spec: its description in the scene.
        origin: (3,) world position of the link frame at joint value 0 [m].
        rot: (3, 3) world rotation of the link frame at joint value 0.
    """

    id: str
    spec: Link
    origin: np.ndarray
    rot: np.ndarray

    @property
    def handle(self) -> Handle:
        """The graspable bar, in the link frame."""
        return self.spec.handle

    @property
    def range(self) -> tuple[float, float]:
        """Joint limits [m or rad]."""
        return self.spec.range

    def pose(self, q: float) -> tuple[np.ndarray, np.ndarray]:
        """World position (3,) [m] and rotation (3, 3) of the link frame at joint value ``q`` [m or rad]."""
        axis = np.asarray(self.spec.axis, float)
        if self.spec.joint == "slide":
            return self.origin + self.rot @ (axis * q), self.rot
        turn = mat_from_quat(quat_from_axis_angle(axis, np.asarray(float(q))))
        return self.origin, self.rot @ turn

    def handle_pose(self, q: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Grasp point [m], bar direction and outward direction, each (3,) in the world, at joint value ``q``."""
        pos, rot = self.pose(q)
        h = self.handle
        return pos + rot @ np.array(h.pos), rot @ np.array(h.bar), rot @ np.array(h.out)

    def boxes(self, q: float) -> Boxes:
        """Collision boxes in the world at joint value ``q`` [m or rad]."""
        pos, rot = self.pose(q)
        return _moved(self._shapes, pos, rot)

    @cached_property
    def _shapes(self) -> Boxes:
        """Collision boxes in the link frame."""
        return _boxes([g for g in self.spec.geoms if g.collide])


@dataclass(frozen=True, eq=False)
class HomeShapes:
    """Static shapes of a home.

    Attributes:
        name: name of the home.
        robot: the robot that acts in it.
        boxes: collision boxes of walls and furniture, without the floor and the moving links.
        links: drawers and doors by id.
        receptacles: receptacles with their world poses.
        map_origin: (2,) world xy of the corner of cell (0, 0) of the free-space map [m].
        map_cell: edge length of a cell [m].
        map_clearance: (nx, ny) distance of each cell's centre to the nearest obstacle [m].
        derived: cache of what is computed from the shapes, such as path planners.
    """

    name: str
    robot: Robot
    boxes: Boxes
    links: dict[str, JointedLink]
    receptacles: tuple[PlacedReceptacle, ...]
    map_origin: np.ndarray
    map_cell: float
    map_clearance: np.ndarray
    derived: MemoryCache = field(default_factory=lambda: MemoryCache("maps"), repr=False)


class WorldView:
    """Privileged view of one world of an environment. It always shows the present state; arrays are copies."""

    def __init__(self, env: PolicyWorlds, world: int) -> None:
        self._env = env
        self.world = world

    @property
    def token(self) -> tuple[int, int, int]:
        """Identity of the active subtask: (seed, episode index, pointer)."""
        episode = self._env.episodes_now[self.world]
        seed, index = (-1, -1) if episode is None else (episode.seed, episode.index)
        return seed, index, int(self._env.progress.pointer[self.world])

    @property
    def config(self) -> TaskConfig:
        """Thresholds of success."""
        return self._env.task_config

    @property
    def done(self) -> bool:
        """Whether the episode has ended."""
        return bool(self._env.progress.done[self.world])

    @property
    def subtask(self) -> Subtask | None:
        """The active subtask, None past the end of the plan."""
        plan = self._env.tables.plans[self.world]
        pointer = int(self._env.progress.pointer[self.world])
        return plan.subtasks[pointer] if pointer < len(plan.subtasks) else None

    @property
    def steps_left(self) -> int:
        """Control steps left for the active subtask."""
        return int(self._env.progress.steps_left[self.world])

    @property
    def steps(self) -> int:
        """Control steps since the episode began."""
        return int(self._env.progress.episode_step[self.world])

    @property
    def home(self) -> HomeShapes:
        """Shapes of the world's home."""
        return home_shapes(self._env.layout, self._env.homes[self.world])

    @property
    def robot(self) -> Robot:
        """The robot of this world."""
        return self._env.layout.robot

    @property
    def q(self) -> np.ndarray:
        """(J,) joint positions: base x, y [m], yaw [rad] in the world, then posture and fingers [m or rad]."""
        # The simulator overwrites its arrays in the next step.
        return self._env.state.robot_q[self.world].copy()

    @property
    def base(self) -> np.ndarray:
        """(3,) x, y [m] and yaw [rad] of the base in the world."""
        return self._env.state.robot_q[self.world, BASE].copy()

    @property
    def qd(self) -> np.ndarray:
        """(J,) joint velocities [m/s or rad/s]."""
        return self._env.state.robot_qd[self.world].copy()

    @property
    def tcp_pose(self) -> np.ndarray:
        """(7,) pose of the tcp in the world, xyz [m] + wxyz."""
        return self._env.sensing.tcp_pose(self._env.state)[self.world]

    @property
    def object_names(self) -> tuple[str, ...]:
        """Names of the object slots, e.g. ``024_bowl_:0001``."""
        return self._env.layout.object_names

    def object_pose(self, name: str) -> np.ndarray:
        """(7,) pose of an object in the world: centre of its bounding box [m], wxyz."""
        return self._env.state.object_pose[
            self.world, self.object_names.index(name)
        ].copy()

    def object_type(self, name: str) -> ObjectType:
        """Shape, size and mass of an object."""
        return self._env.layout.objects[self.object_names.index(name)]

    def object_shape(self, name: str) -> ObjectShape:
        """Shape of an object for grasp planning."""
        layout = self._env.layout
        return shape_of(self.object_type(name), layout.pack.meshes, layout.robot.gripper)

    def link_q(self, link: str) -> float:
        """Joint position of a link by id [m or rad]."""
        return float(
            self._env.state.link_q[self.world, self._env.layout.link_ids.index(link)]
        )

    @property
    def links_run_free(self) -> bool:
        """Whether next to nothing brakes doors and drawers (``joint_dynamics="published"``)."""
        return self._env.layout.joint_dynamics == PUBLISHED_DYNAMICS

    def link_speed(self, link: str) -> float:
        """Joint velocity of a link by id [m/s or rad/s]."""
        return float(
            self._env.state.link_qd[self.world, self._env.layout.link_ids.index(link)]
        )

    def front_area(self, link: str) -> tuple[float, float, float, float] | None:
        """Floor area in front of a link from which it is opened: x_min, x_max, y_min, y_max [m]; None without one."""
        return self._env.boxes[self.world].get(link)

    def finger_forces(self, target: str) -> np.ndarray:
        """(2,) norm of the force [N] of an object or link on the [l, r] finger."""
        names = (*self.object_names, *self._env.layout.link_ids)
        return np.linalg.norm(
            self._env.state.finger_force[self.world, :, names.index(target)], axis=-1
        )

    def signal(self, name: str) -> Any:
        """Value of one of the `Signals` of the active subtask, e.g. ``is_grasped``."""
        assert self._env.signals is not None
        return getattr(self._env.signals, name)[self.world].item()

    @property
    def link_forces(self) -> np.ndarray:
        """(K,) contact force [N] on each robot link without fingers (`Robot.force_links`)."""
        return self._env.state.link_force[self.world].copy()

    def object_boxes(self, leave_out: tuple[str, ...] = ()) -> Boxes:
        """Bounding boxes, in the world, of all objects except those named in ``leave_out``."""
        keep = [i for i, name in enumerate(self.object_names) if name not in leave_out]
        pose = self._env.state.object_pose[self.world, keep]
        half = np.array([self._env.layout.objects[i].half for i in keep]).reshape(-1, 3)
        return Boxes(pose[:, :3].copy(), half, mat_from_quat(pose[:, 3:]))

    def link_boxes(self, leave_out: tuple[str, ...] = ()) -> Boxes:
        """Collision boxes, in the world, of all drawers and doors except those named in ``leave_out``."""
        parts = [
            link.boxes(self.link_q(name))
            for name, link in self.home.links.items()
            if name not in leave_out
        ]
        return Boxes.join(parts)


def home_shapes(layout: Layout, name: str) -> HomeShapes:
    """Shapes of a home of a layout, computed once."""
    return layout.derived.get(("shapes", name), lambda: _home_shapes(layout, name))


def _home_shapes(layout: Layout, name: str) -> HomeShapes:
    home = layout.pack.homes_by_name[name]
    fmap = shared_map(home, layout.pack)
    return HomeShapes(
        name,
        layout.robot,
        _static_boxes(layout, home),
        _links(layout, home),
        placed_receptacles(layout, home),
        np.asarray(fmap.origin, float),
        fmap.cell,
        fmap.clearance,
    )


def _static_boxes(layout: Layout, home: Home) -> Boxes:
    parts = [_boxes([g for g in home.walls if g.collide])]
    for slot, placement in zip(
        layout.prop_slots, layout.slot_placements(home), strict=True
    ):
        prop = layout.pack.props[slot.template]
        # Rugs are driven over.
        if placement is not None and prop.blocks_base:
            parts.append(_placed(prop.geoms, placement, layout.pack))
    for articulation in layout.articulations:
        at = layout.articulation_placement(home, articulation.name)
        parts.append(_placed(articulation.geoms, at, layout.pack))
    return Boxes.join(parts)


def _placed(geoms: tuple[Geom, ...], at: Placement, pack: Pack) -> Boxes:
    """Collision boxes, in the world, of placed shapes; a convex mesh is replaced by the smallest box around it."""
    # Boxes alone, because the planners' kernels know nothing else.
    boxed = [boxed_hull(g, pack) if g.shape == "mesh" else g for g in geoms if g.collide]
    return _moved(_boxes(boxed), np.array(at.pos), mat_from_quat(np.array(at.rotation)))


def _moved(boxes: Boxes, pos: np.ndarray, rot: np.ndarray) -> Boxes:
    """Transform boxes to the world from a frame at ``pos`` (3,), ``rot`` (3, 3)."""
    return Boxes(pos + boxes.center @ rot.T, boxes.half, rot @ boxes.rot)


def _boxes(geoms: list[Geom]) -> Boxes:
    """Bounding boxes of geoms, in the frame of the geoms."""
    half = []
    for g in geoms:
        a, b, c = g.size
        half.append(
            # MuJoCo's sizes: half of the cylinder's length, without the caps of a capsule.
            {"box": (a, b, c), "cylinder": (a, a, b), "capsule": (a, a, a + b)}.get(
                g.shape, (a, a, a)
            )
        )
    local = np.array([g.pos for g in geoms], float).reshape(-1, 3)
    turn = mat_from_quat(np.array([g.quat for g in geoms], float).reshape(-1, 4))
    return Boxes(local, np.array(half, float).reshape(-1, 3), turn)


def _links(layout: Layout, home: Home) -> dict[str, JointedLink]:
    out = {}
    for ref in layout.links:
        at = layout.articulation_placement(home, ref.articulation)
        origin, quat = compose(at.pos, at.rotation, ref.link.pos)
        out[ref.id] = JointedLink(
            ref.id, ref.link, np.array(origin), mat_from_quat(np.array(quat))
        )
    return out
