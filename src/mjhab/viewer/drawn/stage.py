"""The 3-D scene of the page: sends meshes once per home, then the poses of bodies that moved."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import viser

from mjhab.core.rotations import quat_from_mat
from mjhab.render.models import srgb_bytes
from mjhab.viewer.drawn.glb import HomeFiles
from mjhab.viewer.drawn.plan_marks import PlanMarks
from mjhab.viewer.drawn.posing import PosedWorld

MIN_MOVE = 1e-4
"""Smaller changes of a position [m] or of a quaternion's entry are not sent."""
MAX_CONTACTS = 32
LAMP_INTENSITY = 6.0
LAMP_DECAY = 1.4
SKY = (255, 255, 255)
GROUND = (140, 130, 120)
CONTACT_COLOR = (230, 60, 40)
GRASP_COLOR = (40, 200, 90)
GOAL_COLOR = (60, 130, 240)
PATH_COLOR = (250, 190, 40)
PATH_HEIGHT_M = 0.03
PATH_WIDTH_M = 0.02
LABEL_HEIGHT_M = 0.3
PLACEMENT_RADIUS_M = 0.28
CONTACT_RADIUS_M = 0.012
# Below the floor: changing their number would send all of them again.
_HIDDEN = (0.0, 0.0, -100.0)


class DrawnStage:
    """Own the scene nodes of a viser server, which shows one world at a time.

    Args:
        server: the server of the page.

    Attributes:
        sent: number of pose messages sent.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self.sent = 0
        self._server = server
        self._scene = server.scene
        self._placed: list[_Placed] = []
        self._nodes: list[Any] = []
        self._plan: PlanMarks | None = None
        self._plan_nodes: list[Any] = []
        self._scene.configure_default_lights(enabled=False)
        self._scene.configure_environment_map(None)
        self._scene.add_light_hemisphere(
            "/light/sky", sky_color=SKY, ground_color=GROUND, intensity=1.6
        )
        self._contacts = self._spots("/marks/contacts", MAX_CONTACTS, CONTACT_COLOR)
        self._grasp = self._scene.add_icosphere(
            "/marks/grasp", radius=0.03, color=GRASP_COLOR, opacity=0.6, visible=False
        )
        self._goal = self._scene.add_icosphere(
            "/marks/goal", radius=0.05, color=GOAL_COLOR, opacity=0.5, visible=False
        )

    def _spots(self, name: str, count: int, color: tuple[int, int, int]) -> Any:
        ball = _ball(CONTACT_RADIUS_M)
        return self._scene.add_batched_meshes_simple(
            name,
            *ball,
            batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
            batched_positions=np.tile(_HIDDEN, (count, 1)),
            batched_colors=color,
            lod="off",
            cast_shadow=False,
        )

    def show(self, home: HomeFiles, pose: PosedWorld) -> None:
        """Replace the drawn home by another one, with its bodies at ``pose``."""
        # In one piece, or a page would show the home half built.
        with self._server.atomic():
            for node in self._nodes:
                node.remove()
            self._nodes = [self._scene.add_glb("/home", home.home, cast_shadow=False)]
            self._placed = []
            for k, (bodies, data) in enumerate(home.movable):
                placed = _Placed(self._scene, f"/bodies/{k}", bodies, data, pose)
                self._placed.append(placed)
                self._nodes.append(placed.node)
            self._add_lamps(home)

    def _add_lamps(self, home: HomeFiles) -> None:
        for k, (pos, color) in enumerate(
            zip(home.lamp_pos, home.lamp_color, strict=True)
        ):
            strength = float(color.max())
            x, y, z = pos.tolist()
            r, g, b = srgb_bytes(color / strength).tolist()
            lamp = self._scene.add_light_point(
                f"/light/lamp{k}",
                color=(r, g, b),
                intensity=LAMP_INTENSITY * strength,
                decay=LAMP_DECAY,
                position=(x, y, z),
            )
            self._nodes.append(lamp)

    def place(self, pose: PosedWorld) -> None:
        """Move bodies and contact marks to a pose."""
        with self._server.atomic():
            for placed in self._placed:
                self.sent += placed.move(pose)
            self._mark_contacts(pose.contacts)

    def _mark_contacts(self, contacts: np.ndarray) -> None:
        positions = np.tile(np.asarray(_HIDDEN, np.float32), (MAX_CONTACTS, 1))
        shown = contacts[:MAX_CONTACTS]
        positions[: len(shown)] = shown
        # Most states have the same contacts as the one before, and nothing is sent.
        if not np.array_equal(positions, self._contacts.batched_positions):
            self._contacts.batched_positions = positions

    def mark_plan(self, plan: PlanMarks | None) -> None:
        """Draw the path, base placement and grasp candidates of the expert's plan; None removes them."""
        if plan is self._plan:
            return
        self._plan = plan
        with self._server.atomic():
            for node in self._plan_nodes:
                node.remove()
            self._plan_nodes = [] if plan is None else list(self._draw_plan(plan))

    def _draw_plan(self, plan: PlanMarks) -> Iterator[Any]:
        scene = self._scene
        if len(plan.path) > 1:
            points = np.insert(plan.path, 2, PATH_HEIGHT_M, axis=1)
            lines = np.stack([points[:-1], points[1:]], axis=1)
            yield scene.add_line_segments(
                "/plan/path", lines, PATH_COLOR, thickness=PATH_WIDTH_M
            )
        if plan.placement is not None:
            x, y, yaw = plan.placement.tolist()
            turn = (np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2))
            yield scene.add_cylinder(
                "/plan/placement",
                radius=PLACEMENT_RADIUS_M,
                height=0.01,
                color=PATH_COLOR,
                opacity=0.5,
                position=(x, y, PATH_HEIGHT_M),
            )
            if plan.phase:
                at = (x, y, LABEL_HEIGHT_M)
                yield scene.add_label("/plan/phase", plan.phase, position=at)
            yield scene.add_frame(
                "/plan/heading",
                axes_length=0.4,
                axes_radius=0.01,
                wxyz=turn,
                position=(x, y, PATH_HEIGHT_M),
            )
        if len(plan.hands):
            quats = quat_from_mat(plan.hands[:, :3, :3])
            yield scene.add_batched_axes(
                "/plan/hands",
                quats,
                plan.hands[:, :3, 3],
                axes_length=0.05,
                axes_radius=0.002,
            )
        if plan.chosen is not None and plan.chosen < len(plan.hands):
            hand = plan.hands[plan.chosen]
            yield scene.add_frame(
                "/plan/hand",
                axes_length=0.12,
                axes_radius=0.006,
                wxyz=quat_from_mat(hand[:3, :3]),
                position=hand[:3, 3],
            )

    def mark_grasp(self, point: np.ndarray | None) -> None:
        """Mark the point (3,) [m] at which an object is grasped; None hides the mark."""
        _mark(self._grasp, point)

    def mark_goal(self, point: np.ndarray | None) -> None:
        """Mark the goal position (3,) [m] of the active subtask; None hides the mark."""
        _mark(self._goal, point)


class _Placed:
    """Scene node of a model, drawn at every body that has it."""

    def __init__(
        self,
        scene: viser.SceneApi,
        name: str,
        bodies: tuple[int, ...],
        data: bytes,
        pose: PosedWorld,
    ) -> None:
        self._bodies = list(bodies)
        self._pos = pose.pos[self._bodies].astype(np.float32)
        self._quat = pose.quat[self._bodies].astype(np.float32)
        self._single = len(self._bodies) == 1
        if self._single:
            self.node: Any = scene.add_glb(
                name, data, wxyz=self._quat[0], position=self._pos[0], cast_shadow=False
            )
        else:
            self.node = scene.add_batched_glb(
                name, data, self._quat, self._pos, lod="off", cast_shadow=False
            )

    def move(self, pose: PosedWorld) -> int:
        """Send the poses of the bodies if any moved by more than `MIN_MOVE`; returns the number of messages."""
        pos = pose.pos[self._bodies].astype(np.float32)
        quat = pose.quat[self._bodies].astype(np.float32)
        moved = bool((np.abs(pos - self._pos) > MIN_MOVE).any())
        turned = bool((np.abs(quat - self._quat) > MIN_MOVE).any())
        if moved:
            self._pos = pos
            if self._single:
                self.node.position = pos[0]
            else:
                self.node.batched_positions = pos
        if turned:
            self._quat = quat
            if self._single:
                self.node.wxyz = quat[0]
            else:
                self.node.batched_wxyzs = quat
        return moved + turned


def _mark(node: Any, point: np.ndarray | None) -> None:
    shown = point is not None
    if node.visible != shown:
        node.visible = shown
    if point is not None and np.abs(np.asarray(node.position) - point).max() > MIN_MOVE:
        node.position = point


def _ball(radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (6, 3) [m] and faces (8, 3) of an octahedron."""
    corners = radius * np.array(
        [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)], np.float32
    )
    faces = [
        (0, 2, 4),
        (2, 1, 4),
        (1, 3, 4),
        (3, 0, 4),
        (2, 0, 5),
        (1, 2, 5),
        (3, 1, 5),
        (0, 3, 5),
    ]
    return corners, np.array(faces, np.uint32)
