"""Images of the worlds of a layout: what the robot's cameras see, and pictures for people from any place."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from mjhab.core.joints import BASE
from mjhab.core.rotations import mat_from_quat
from mjhab.render.cameras import Cameras, look_at
from mjhab.render.layout_scene import build_render_scene
from mjhab.render.pictures.follow_camera import FollowCamera
from mjhab.render.raster.arrays import DIVERGED_BEYOND_M
from mjhab.render.raster.rasterizer import FAST, FILM, QualityName, Rasterizer
from mjhab.scenes.shading import Shading
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.protocol import SimState

if TYPE_CHECKING:
    from mjhab.render.path_tracer.tracer import PathTracer

ROBOT_LEVEL_ERROR = 0.4
"""Allowed error of levels of detail [px] in images of the robot's cameras. In `mjhab/PickSubtaskTrain-v1` it changes
the depth of 0.13 % of the pixels at 128 x 128, and of 0.53 % at 32 x 32, by more than 1 cm; the mean change is 0.6 mm
and 1.4 mm."""
FOLLOW_FOVY = 0.85
"""Vertical field of view of the follow camera [rad]."""


class BodyPoses(Protocol):
    """World poses of the B bodies of W worlds; `SimState` is one."""

    @property
    def body_pos(self) -> Any:
        """(W, B, 3) positions in the world [m]."""
        ...

    @property
    def body_mat(self) -> Any:
        """(W, B, 3, 3) rotation matrices from body to world."""
        ...


class CameraChange(NamedTuple):
    """How C cameras of W worlds differ from their mounts.

    Attributes:
        shift: (W, C, 3) change of the position in the axes of the camera [m].
        turn: (W, C, 3, 3) rotation in the axes of the camera.
        widen: (W, C) factor of the tangent of half the field of view.
    """

    shift: np.ndarray
    turn: np.ndarray
    widen: np.ndarray

    def applied(
        self, pos: np.ndarray, mat: np.ndarray, fovy: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions (W, C, 3), orientations (W, C, 3, 3) and fields of view (W, C) [rad] of the changed cameras."""
        moved = pos + np.einsum("wcij,wcj->wci", mat, self.shift)
        # The tangent is what an image is wide by; scaled angles would distort wide views.
        wide = 2.0 * np.arctan(self.widen * np.tan(0.5 * np.asarray(fovy)))
        return moved, mat @ self.turn, wide


class ViewChange(NamedTuple):
    """How views of the robot's cameras in W worlds differ from what they should be.

    Attributes:
        mounts: of the cameras; None for no difference.
        looks: (W, M), the material that each of the M of the scene is drawn as; None for its own. The path tracer
            does not have it.
    """

    mounts: CameraChange | None
    looks: np.ndarray | None


class _Mounts(NamedTuple):
    """Places of C robot cameras: body ids (C,), positions (C, 3) [m] and rotations (C, 3, 3) on these bodies, and
    vertical fields of view (C,) [rad]."""

    bodies: np.ndarray
    pos: np.ndarray
    mat: np.ndarray
    fovy: np.ndarray


def is_sane(body_pos: np.ndarray, body_mat: np.ndarray) -> np.ndarray:
    """(W,) bool: worlds whose physics has not diverged, for poses (W, B, 3) and (W, B, 3, 3) of their bodies.

    The kernels have no bounds checks, so that poses of the others must not reach them.
    """
    # NaN fails the comparisons.
    near = (np.abs(body_pos) < DIVERGED_BEYOND_M).all((1, 2))
    # Entries of rotations are at most 1, with room for rounding.
    return np.asarray(near & (np.abs(body_mat) < 2.0).all((1, 2, 3)))


def _placed(images: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Images (W, ...) of all worlds, from those of the worlds ``rows`` (W,) bool; zeros for the others."""
    # The usual case needs no copy.
    if rows.all():
        return images
    whole = np.zeros((len(rows), *images.shape[1:]), images.dtype)
    whole[rows] = images
    return whole


class HomeRenderer:
    """Render the worlds of a simulator with the CPU rasterizer, their colours by the path tracer if that is asked for.

    Args:
        sim: provides the layout and the compiled models.
        num_threads: number of threads of the rasterizer; 0 uses one per core.
        shading: options of the path tracer; None draws colours with the rasterizer.

    Raises:
        UsageError: the path tracer cannot run here, see `path_tracer.library.mitsuba`.
    """

    def __init__(
        self, sim: CpuSimulator, num_threads: int = 0, shading: Shading | None = None
    ) -> None:
        self._sim = sim
        self.layout = sim.layout
        # Models of all homes of a layout have the same bodies.
        self._model = sim.model(sim.layout.pack.homes[0].name)
        self.scene = build_render_scene(sim.layout, self._model)
        self.rasterizer = Rasterizer(self.scene, num_threads)
        self._home_index = {home.name: i for i, home in enumerate(sim.layout.pack.homes)}
        self.follow = FollowCamera(sim.model)
        self._dressed: Rasterizer | None = None
        self._mounts: dict[tuple[str, ...], _Mounts] = {}
        self.tracer: PathTracer | None = None
        if shading is not None:
            from mjhab.render.path_tracer.tracer import PathTracer  # of the extra photo

            self.tracer = PathTracer(self.scene, shading)

    @property
    def dressed(self) -> Rasterizer:
        """Draws pictures for people: homes with ceilings (`layout_scene.build_render_scene`); made on first use."""
        if self._dressed is None:
            scene = build_render_scene(self.layout, self._model, dressed=True)
            self._dressed = Rasterizer(scene, self.rasterizer.num_threads)
        return self._dressed

    def render(
        self,
        home: np.ndarray,
        body_pos: np.ndarray,
        body_mat: np.ndarray,
        cameras: Cameras,
        outputs: Sequence[str],
        quality: QualityName = FAST,
        looks: np.ndarray | None = None,
    ) -> dict[str, np.ndarray]:
        """As `Rasterizer.render`; colours are those of the path tracer if there is one, without ``looks``.

        In any quality but "fast", which observations have, homes are `dressed`.
        """
        tracer = self.tracer if "rgb" in outputs else None
        drawn = set(outputs)
        if tracer is not None:
            drawn -= {"rgb"}
            drawn |= set(tracer.guides)
            # Perturbed looks are of the rasterizer; the tracer has materials of its own.
            looks = None
        images = {}
        if drawn:
            # Observations stay as policies were trained on them.
            rasterizer = self.rasterizer if quality == FAST else self.dressed
            images = rasterizer.render(
                home, body_pos, body_mat, cameras, sorted(drawn), quality, looks=looks
            )
        if tracer is not None:
            images["rgb"] = tracer.render(
                home, body_pos, body_mat, cameras, images, quality
            )
        return {name: images[name] for name in outputs}

    def picture(
        self,
        state: BodyPoses,
        world: int,
        home: str,
        cameras: Cameras,
        quality: QualityName = FILM,
    ) -> np.ndarray:
        """Colours (C, height, width, 3) uint8 sRGB of one world for people; zeros where its physics has diverged."""
        return self.pictures(state, [world], [home], cameras, quality)[0]

    def pictures(
        self,
        state: BodyPoses,
        worlds: Sequence[int],
        homes: Sequence[str],
        cameras: Cameras,
        quality: QualityName = FILM,
    ) -> np.ndarray:
        """Colours (W, C, height, width, 3) uint8 sRGB of some worlds for people, drawn at the same time.

        All are zero if the physics of one of them has diverged.
        """
        pos, mat = state.body_pos[list(worlds)], state.body_mat[list(worlds)]
        if not is_sane(pos, mat).all():
            shape = (*np.shape(cameras.pos)[:2], cameras.height, cameras.width, 3)
            return np.zeros(shape, np.uint8)
        index = self.home_numbers(homes)
        return self.render(index, pos, mat, cameras, ("rgb",), quality)["rgb"]

    def robot_views(
        self,
        state: BodyPoses,
        homes: Sequence[str],
        size: int | tuple[int, int],
        outputs: Sequence[str],
        cameras: Sequence[str] | None = None,
        changed: ViewChange | None = None,
    ) -> dict[str, np.ndarray]:
        """Render robot cameras in all worlds.

        A world whose physics has diverged (poses not finite, or beyond `DIVERGED_BEYOND_M`) gets images of zeros.

        Args:
            state: poses of the bodies.
            homes: (W,) names of the worlds' homes.
            size: side, or (height, width) [px].
            outputs: any of "rgb", "depth", "seg".
            cameras: names of C robot cameras; None takes all.
            changed: how the views differ from what they should be, if they do.

        Returns:
            (W, C, height, width[, 3]) by output, as `Rasterizer.render` returns them.

        Raises:
            UsageError: unknown camera or output.
        """
        height, width = (size, size) if isinstance(size, int) else size
        index = self.home_numbers(homes)
        fovy = self.fields_of_view(cameras)
        pos, mat = self.camera_poses(state, cameras)
        sane = is_sane(state.body_pos, state.body_mat)
        rows = slice(None) if sane.all() else sane
        mounts, looks = changed if changed is not None else (None, None)
        if mounts is not None:
            pos, mat, fovy = mounts.applied(pos, mat, fovy)
            # Changed views have a field of view per world, others one for all.
            fovy = fovy[rows]
        drawn = self.render(
            index[rows],
            state.body_pos[rows],
            state.body_mat[rows],
            Cameras(pos[rows], mat[rows], fovy, width, height, ROBOT_LEVEL_ERROR),
            outputs,
            looks=looks if looks is None else looks[rows],
        )
        return {name: _placed(image, sane) for name, image in drawn.items()}

    def home_numbers(self, homes: Sequence[str]) -> np.ndarray:
        """Indices (n,) of homes in the render scene."""
        return np.array([self._home_index[home] for home in homes], np.int64)

    def fields_of_view(self, cameras: Sequence[str] | None = None) -> np.ndarray:
        """Vertical fields of view (C,) [rad] of robot cameras, of all for None."""
        return self._mounts_of(cameras).fovy

    def camera_poses(
        self, state: BodyPoses, cameras: Sequence[str] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute the world poses of robot cameras.

        Args:
            state: poses of the bodies.
            cameras: names of C robot cameras; None takes all.

        Returns:
            Positions (W, C, 3) [m] and orientations (W, C, 3, 3), whose columns are the camera's axes: x right, y up,
            z backwards.

        Raises:
            UsageError: unknown camera.
        """
        mounts = self._mounts_of(cameras)
        mat = state.body_mat[:, mounts.bodies]
        pos = state.body_pos[:, mounts.bodies] + np.einsum(
            "wcij,cj->wci", mat, mounts.pos
        )
        return pos, mat @ mounts.mat

    def _mounts_of(self, names: Sequence[str] | None) -> _Mounts:
        """Places of the named robot cameras, of all for None; looked up once, because that costs more than a pose."""
        robot = self.layout.robot
        key = tuple(robot.camera_names if names is None else names)
        if key not in self._mounts:
            cameras = [robot.camera(name) for name in key]
            self._mounts[key] = _Mounts(
                np.array([self._model.body(camera.body).id for camera in cameras]),
                np.array([camera.pos for camera in cameras]),
                mat_from_quat(np.array([camera.quat for camera in cameras])),
                np.array([camera.fovy for camera in cameras]),
            )
        return self._mounts[key]

    def follow_view(
        self, state: SimState, home: str, world: int, width: int, height: int
    ) -> np.ndarray:
        """Render the follow camera in one world: (height, width, 3) uint8, see `follow_views`."""
        return self.follow_views(state, [home], [world], width, height)[0]

    def follow_views(
        self,
        state: SimState,
        homes: Sequence[str],
        worlds: Sequence[int],
        width: int,
        height: int,
    ) -> np.ndarray:
        """Render the follow camera, which looks from behind the robot over its shoulder, in n worlds.

        A world whose physics has diverged gets an image of zeros, see `robot_views`.

        Args:
            state: of all worlds.
            homes: (n,) names of the homes of these worlds.
            worlds: (n,) indices of the worlds.
            width, height: of the images [px].

        Returns:
            (n, height, width, 3) uint8 sRGB.
        """
        sane = is_sane(state.body_pos[list(worlds)], state.body_mat[list(worlds)])
        drawn = [
            (home, world)
            for home, world, good in zip(homes, worlds, sane, strict=True)
            if good
        ]
        if not drawn:
            return np.zeros((len(sane), height, width, 3), np.uint8)
        rows = [world for _, world in drawn]
        looks = [
            self.follow.look(home, state.robot_q[world, BASE]) for home, world in drawn
        ]
        images = self.render(
            self.home_numbers([home for home, _ in drawn]),
            state.body_pos[rows],
            state.body_mat[rows],
            Cameras(
                np.stack([eye for eye, _ in looks])[:, None],
                np.stack(
                    [look_at(eye.tolist(), target.tolist()) for eye, target in looks]
                )[:, None],
                FOLLOW_FOVY,
                width,
                height,
            ),
            ("rgb",),
            FILM,
        )
        return _placed(images["rgb"][:, 0], sane)
