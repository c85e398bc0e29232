"""Observations of a mode, computed on the host: state vector, camera images, point clouds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from mjhab.core.arrays import map_record
from mjhab.core.conventions.images import COLOURS, TARGET_OUTPUTS
from mjhab.core.errors import UsageError
from mjhab.core.joints import BASE, BASE_X, BASE_Y, BASE_YAW
from mjhab.envs.observations.cameras import camera_table, intrinsic_matrix
from mjhab.envs.observations.entry import CameraInputs
from mjhab.envs.observations.modes import (
    DRAWN_OUTPUTS,
    POINTCLOUD,
    PROPRIOCEPTION,
    camera_names,
    image_size,
    mode_outputs,
    own_state_only,
)
from mjhab.envs.observations.state import (
    GOAL_KEY,
    OBJECT_KEY,
    state_observation,
    state_table,
)
from mjhab.envs.observations.table import describe, table_space
from mjhab.envs.parts.drawn import DrawnImages
from mjhab.envs.parts.plan_tables import Focus
from mjhab.envs.parts.sensing import Sensing
from mjhab.robots.robot import Robot
from mjhab.scenes.shading import Shading
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.protocol import SimState
from mjhab.tasks.signals import Signals
from mjhab.tasks.subtasks.registry import SUBTASKS, properties

if TYPE_CHECKING:
    from mjhab.envs.parts.perturbing import PerturbedMoment, Perturber
    from mjhab.render.home_scene import HomeRenderer


class ObservedRows:
    """The observation table of a mode, the same on all backends.

    Args:
        robot: the robot.
        mode: parts of OBS_MODES joined by "+", e.g. "state", "rgbd+seg".
        cameras: names of the robot's cameras, all if None; their order is that of the points in a point cloud.
        size: side of the images [px], or (height, width). The vertical field of view does not depend on it.

    Attributes:
        outputs: images and point clouds of the mode, see `mode_outputs`.
        drawn: images of the cameras that a renderer must draw for them.
        cameras: names of the cameras.
        size: (height, width) of the images [px].
        state_rows: rows of ``state``.
        camera_rows: rows that need images.
        target_outputs: those of `outputs` that are views of the target.
        table: all rows.
        single_space: observation space of one world.

    Raises:
        UsageError: unknown mode or camera, size below 8 pixels.
    """

    def __init__(
        self,
        robot: Robot,
        mode: str = "state",
        cameras: str | Sequence[str] | None = None,
        size: int | Sequence[int] = 128,
    ) -> None:
        self.robot = robot
        self.outputs = mode_outputs(mode)
        # A point cloud is made of all three.
        self.drawn = tuple(
            name
            for name in DRAWN_OUTPUTS
            if name in self.outputs or POINTCLOUD in self.outputs
        )
        self.target_outputs = tuple(
            name for name in TARGET_OUTPUTS if name in self.outputs
        )
        if self.target_outputs and own_state_only(mode):
            raise UsageError(
                f"obs_mode {mode!r}: {self.target_outputs[0]} looks at the target of the subtask, which "
                f"{PROPRIOCEPTION} hides; leave out one of them.",
                option="obs_mode",
                given=mode,
            )
        self.cameras = camera_names(
            robot, robot.camera_names if cameras is None else cameras
        )
        self.size = image_size(size)
        self.state_rows = state_table(robot, own_state_only(mode))
        self.camera_rows = camera_table(robot, self.outputs, self.cameras, self.size)
        self.table = self.state_rows + self.camera_rows
        self.single_space = table_space(self.state_rows, self.camera_rows)

    def calibration(self) -> dict[str, dict[str, Any]]:
        """Calibration of each camera as plain data, by its name.

        "size": (height, width) [px]; "intrinsic": pinhole matrix [px], pixel centres lie at + 0.5; "body", "pos" [m],
        "quat" (wxyz): its pose on the robot, with the axes of MuJoCo's cameras (x right, y up, looking along -z).
        The observations "sensor_param/<camera>/..." give its pose in the world.
        """
        mounts = {name: self.robot.camera(name) for name in self.cameras}
        return {
            name: {
                "size": list(self.size),
                "intrinsic": intrinsic_matrix(self.robot, name, self.size).tolist(),
                "body": mount.body,
                "pos": list(mount.pos),
                "quat": list(mount.quat),
            }
            for name, mount in mounts.items()
        }

    def describe(self, kinds: Sequence[str] | None = None) -> list[dict[str, Any]]:
        """Describe the rows of the table as plain data: key, shape, dtype, unit, frame, meaning.

        ``kinds``: subtasks for which the task rows are explained, all registered ones if None.

        Raises:
            UsageError: there is no such subtask.
        """
        return describe(
            self.state_rows,
            self.camera_rows,
            SUBTASKS.names() if kinds is None else kinds,
        )


class Observer(ObservedRows):
    """Computes the rows of the observation table for all worlds on the host.

    Segmentation ids are the same in every home and world of a layout: id i is ``segmentation_names[i]``, one of
    "background" (0, nothing hit), "floor", "wall", a piece of furniture by its name, "<articulation>/<link>" for its
    doors and drawers, an object by its name in the layout, "robot/<link>".

    Args:
        sim: simulator of the worlds.
        sensing: sensing of the same layout.
        mode: see `ObservedRows`.
        cameras: see `ObservedRows`.
        size: see `ObservedRows`.
        threads: threads of the renderer, over images; 0 takes every core.
        remembers: keep a copy of the images, so that worlds that look as before are not drawn again: for environments
            of which some worlds are reset between steps.
        shading: options of the path tracer; None takes the rasterizer.

    Raises:
        UsageError: unknown mode or camera, size below 8 pixels, or the path tracer cannot run here.
    """

    def __init__(
        self,
        sim: CpuSimulator,
        sensing: Sensing,
        mode: str = "state",
        cameras: str | Sequence[str] | None = None,
        size: int | Sequence[int] = 128,
        threads: int = 0,
        *,
        remembers: bool = False,
        shading: Shading | None = None,
    ) -> None:
        super().__init__(sim.layout.robot, mode, cameras, size)
        self.shading = shading
        if shading is not None:
            from mjhab.render.path_tracer.library import mitsuba

            # Now, and not when the first picture is drawn.
            mitsuba(shading.variant)
        self._sim = sim
        self._sensing = sensing
        self._threads = threads
        self._intrinsic = np.stack(
            [intrinsic_matrix(self.robot, name, self.size) for name in self.cameras]
        )
        self._renderer: HomeRenderer | None = None
        self._remembers = remembers
        self._drawn: DrawnImages | None = None
        self.perturber: Perturber | None = None
        """What perturbs images; None for nothing."""

    @property
    def renderer(self) -> HomeRenderer:
        """The renderer of this layout, made on first use."""
        if self._renderer is None:
            from mjhab.render.home_scene import HomeRenderer  # loads numba and trimesh

            self._renderer = HomeRenderer(self._sim, self._threads, self.shading)
        return self._renderer

    @property
    def segmentation_names(self) -> tuple[str, ...]:
        """Name of every segmentation id, index = id."""
        return self.renderer.scene.seg_names

    def observe(
        self,
        state: SimState,
        focus: Focus,
        signals: Signals,
        homes: Sequence[str],
        known: Mapping[str, np.ndarray] | None = None,
        changed: np.ndarray | None = None,
    ) -> dict[str, np.ndarray]:
        """Compute observations (W, ...) of all worlds.

        Args:
            state: state of the simulator after the control step or reset.
            focus: the active subtasks; rows that a subtask does not use are zero.
            signals: signals measured in this state.
            homes: (W,) name of each world's home.
            known: observations from earlier in this step, whose images are reused.
            changed: (W,) bool, worlds whose state has changed since ``known``; their images are drawn again.
        """
        obs = state_observation(
            self.state_rows, self._sensing.context(state, focus, signals)
        )
        if self.outputs:
            target = None
            if self.target_outputs:
                target = target_in_base(obs[OBJECT_KEY], obs[GOAL_KEY], focus.kind)
            if known is None and self._drawn is not None:
                known = self._drawn.images
                changed = self._drawn.outdated(state, homes, target)
            # All anew is one call; copying what is known would be for nothing.
            if known is None or changed is None or changed.all():
                images = self.draw(state, homes, target, self._moments())
            else:
                images = self._drawn_again(known, changed, state, homes, target)
            # Noise of sensing is another one in every control step.
            if self._remembers and self.perturber is None:
                self._drawn = DrawnImages(images, state, homes, target)
            obs |= images
        return obs

    def _drawn_again(
        self,
        known: Mapping[str, np.ndarray],
        changed: np.ndarray,
        state: SimState,
        homes: Sequence[str],
        target: np.ndarray | None,
    ) -> dict[str, np.ndarray]:
        """The images (W, ...) of ``known``, with those of the worlds ``changed`` drawn again."""
        # Copies: observations that were returned are never modified.
        images = {entry.key: known[entry.key].copy() for entry in self.camera_rows}
        worlds = np.flatnonzero(changed)
        moments = self._moments()
        if len(worlds):
            drawn = self.draw(
                map_record(lambda rows: rows[worlds], state),
                [homes[w] for w in worlds.tolist()],
                target if target is None else target[worlds],
                [moments[w] for w in worlds.tolist()] if moments else (),
            )
            for key, rows in drawn.items():
                images[key][worlds] = rows
        return images

    def _moments(self) -> Sequence[PerturbedMoment]:
        """The present moments of all worlds; () if no image is perturbed."""
        return () if self.perturber is None else self.perturber.moments()

    def draw(
        self,
        state: SimState,
        homes: Sequence[str],
        target: np.ndarray | None = None,
        moments: Sequence[PerturbedMoment] = (),
    ) -> dict[str, np.ndarray]:
        """Draw the camera images of the worlds of ``state`` and compute the camera rows (W, ...) from them.

        Args:
            state: poses of the bodies.
            homes: (W,) names of the worlds' homes.
            target: for views of the target, see `target_in_base`.
            moments: (W,) when the images are taken, for what perturbs them; () for images as they are.
        """
        pos, mat = self.renderer.camera_poses(state, self.cameras)
        perturber = self.perturber if len(moments) else None
        changed = None
        if perturber is not None:
            coloured = {*self.drawn, *self.target_outputs} & {*COLOURS}
            # Materials matter for colours alone.
            scene = self.renderer.scene if coloured else None
            changed = perturber.views(moments, self.cameras, scene)
        images: dict[str, np.ndarray] = {}
        if self.drawn:
            more: tuple[str, ...] = ()
            if perturber is not None and "rgb" in self.drawn:
                # Depth and segments cost time, and only changes of colours ask for them.
                more = tuple(sorted(perturber.needs - {*self.drawn}))
            images = self.renderer.robot_views(
                state, homes, self.size, (*self.drawn, *more), self.cameras, changed
            )
        if self.target_outputs:
            assert target is not None
            place = _in_world(state.robot_q[:, BASE], self.robot.base_height, target)
            from mjhab.render.target_views import (  # loads numba
                PerturbedViews,
                target_views,
            )

            perturbed = None
            if perturber is not None and changed is not None:
                perturbed = PerturbedViews(
                    changed,
                    perturber.needs,
                    lambda world, *seen: perturber.picture(moments[world], *seen),
                )
            looking = (self.renderer, state, homes, place, self.size, self.cameras)
            images |= target_views(*looking, self.target_outputs, perturbed)
        if perturber is not None and changed is not None:
            fovy = self.renderer.fields_of_view(self.cameras)
            seen = (pos, mat, np.broadcast_to(fovy, pos.shape[:2]))
            mounts = changed.mounts
            # The image is that of the moved camera, while its parameters tell the nominal one.
            _, true_mat, true_fovy = mounts.applied(*seen) if mounts else seen
            focal = 0.5 * self.size[0] / np.tan(0.5 * true_fovy)
            perturber.pictures(moments, images, true_mat, focal)
        views = CameraInputs(
            self.robot, images, pos, mat, state.robot_q[:, BASE], self._intrinsic
        )
        return {entry.key: entry.compute(views) for entry in self.camera_rows}


def target_in_base(
    object_pose: np.ndarray, goal: np.ndarray, kind: np.ndarray
) -> np.ndarray:
    """Targets (W, 3) float32 of the hand in the active subtasks, in the frame of the base link [m].

    Args:
        object_pose, goal: (W, 7) and (W, 3) float32, as observed.
        kind: (W,) int64 kinds of the subtasks; the last ones of finished plans.
    """
    (aims,) = properties(kind, "aims_at_goal")
    return np.where(aims[:, None], goal, object_pose[:, :3])


def _in_world(base: np.ndarray, height: float, points: np.ndarray) -> np.ndarray:
    """Points (W, 3) of the frames of base links at (W, 3) x, y [m], yaw [rad] in the world."""
    cos = np.cos(base[:, BASE_YAW])
    sin = np.sin(base[:, BASE_YAW])
    x, y, z = points.astype(np.float64).T
    return np.stack(
        [
            base[:, BASE_X] + cos * x - sin * y,
            base[:, BASE_Y] + sin * x + cos * y,
            z + height,
        ],
        axis=1,
    )
