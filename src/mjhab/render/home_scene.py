"""The render scene of a layout and images of it: robot cameras, the follow camera of films, views of a home."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol

import mujoco
import numpy as np

from mjhab.core.boxes import sphere_box_distance
from mjhab.core.errors import unknown_name
from mjhab.core.joints import BASE
from mjhab.core.rotations import mat_from_quat
from mjhab.layout.layout import Layout
from mjhab.render.build_scene import SceneBuilder
from mjhab.render.follow_camera import FollowCamera
from mjhab.render.primitives import box_mesh
from mjhab.render.raster.arrays import DIVERGED_BEYOND_M
from mjhab.render.raster.rasterizer import Cameras, Rasterizer, look_at
from mjhab.render.render_scene import RenderScene
from mjhab.scenes.builtin.materials import MATERIALS
from mjhab.scenes.freespace import free_map
from mjhab.scenes.shading import Shading
from mjhab.scenes.spec import IDENTITY, PARKED, Geom, Home, Placement
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.mujoco.settle import parked_robot_qpos
from mjhab.sim.protocol import SimState

if TYPE_CHECKING:
    from mjhab.render.path_tracer.tracer import PathTracer

VIEWS = ("top", "inside")
ROBOT_LEVEL_ERROR = 0.4
"""Allowed error of levels of detail [px] in images of the robot's cameras. In `mjhab/PickSubtaskTrain-v1` it changes
the depth of 0.13 % of the pixels at 128 x 128, and of 0.53 % at 32 x 32, by more than 1 cm; the mean change is 0.6 mm
and 1.4 mm."""
FLOOR_HALF_THICKNESS = 0.02
"""Half the thickness of drawn floors [m]."""
FOLLOW_FOVY = 0.85
"""Vertical field of view of the follow camera [rad]."""
HOME_FOVY = 0.8
"""Vertical field of view of the "top" view [rad]."""
INSIDE_HEIGHT = 2.0
"""Height of the camera of the "inside" view [m]."""


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


def build_render_scene(layout: Layout, model: mujoco.MjModel) -> RenderScene:
    """The render scene of all homes of a layout; layouts of one pack, roster and robot share it.

    Args:
        layout: robot, homes, furniture and objects.
        model: the compiled model of any home of the layout; gives the body ids, which all homes share.
    """
    # It takes a second for the built-in homes, and evaluations and tests open many environments of them.
    key = ("render scene", layout.roster, layout.robot)
    return layout.pack.derived.get(key, lambda: _build(layout, model))


def _build(layout: Layout, model: mujoco.MjModel) -> RenderScene:
    homes = layout.pack.homes
    builder = SceneBuilder(len(homes), {**MATERIALS, **layout.robot.materials})
    meshes = layout.pack.meshes
    _add_shell(builder, layout)
    for i, slot in enumerate(layout.prop_slots):
        at = [layout.slot_placements(home)[i] for home in homes]
        _add_standing(
            builder, layout.pack.props[slot.template].geoms, at, slot.name, meshes
        )
    for articulation in layout.articulations:
        at = [layout.articulation_placement(home, articulation.name) for home in homes]
        _add_standing(builder, articulation.geoms, at, articulation.name, meshes)
        for link in articulation.links:
            name = f"{articulation.name}/{link.name}"
            for geom in link.geoms:
                if geom.visual:
                    builder.add_body_geom(geom, model.body(name).id, name, meshes)
    for name, kind in zip(layout.object_names, layout.objects, strict=True):
        for geom in kind.visuals:
            builder.add_body_geom(geom, model.body(name).id, name, meshes)
    for k, (link, mesh, material) in enumerate(layout.robot.visuals()):
        mesh_id = builder.add_mesh(("robot", k), mesh)
        look = builder.material(material)
        builder.add_body_instance(
            mesh_id, model.body(link).id, material=look, seg=f"robot/{link}"
        )
    for h, home in enumerate(homes):
        for light in home.lights:
            builder.add_light(h, light)
    return builder.build()


def _add_shell(builder: SceneBuilder, layout: Layout) -> None:
    """Add floors, floor patches and walls as unit boxes with a pose, scale and material per home."""
    homes = layout.pack.homes
    unit = builder.add_mesh("unit box", box_mesh((1.0, 1.0, 1.0)))
    floors = []
    for home in homes:
        x0, y0, x1, y1 = home.floor
        size = ((x1 - x0) / 2, (y1 - y0) / 2, FLOOR_HALF_THICKNESS)
        center = ((x0 + x1) / 2, (y0 + y1) / 2, -FLOOR_HALF_THICKNESS)
        floors.append(Geom("box", size, center, material=home.floor_material))
    _add_boxes(builder, unit, [(geom,) for geom in floors], "floor")
    _add_boxes(builder, unit, [home.floor_patches for home in homes], "floor")
    _add_boxes(builder, unit, [home.walls for home in homes], "wall")


def _add_boxes(
    builder: SceneBuilder, unit: int, boxes: Sequence[tuple[Geom, ...]], seg: str
) -> None:
    absent = Geom("box", (0.0, 0.0, 0.0), PARKED)
    for k in range(max(len(row) for row in boxes)):
        row = [b[k] if k < len(b) else absent for b in boxes]
        builder.add_world_instance(
            unit,
            np.array([g.pos for g in row]),
            np.array([g.quat for g in row]),
            np.array([g.size for g in row]),
            [builder.material(g.material) for g in row],
            seg,
        )


def _add_standing(
    builder: SceneBuilder,
    geoms: tuple[Geom, ...],
    at: Sequence[Placement | None],
    seg: str,
    meshes: dict[str, object],
) -> None:
    pos = np.array([PARKED if p is None else p.pos for p in at])
    quat = np.array([IDENTITY if p is None else p.rotation for p in at])
    present = np.array([p is not None for p in at])
    for geom in geoms:
        if geom.visual:
            builder.add_world_geom(geom, pos, quat, seg, present, meshes)


def is_sane(body_pos: np.ndarray, body_mat: np.ndarray) -> np.ndarray:
    """(W,) bool: worlds whose physics has not diverged, for poses (W, B, 3) and (W, B, 3, 3) of their bodies.

    The kernels have no bounds checks, so that poses of the others must not reach them.
    """
    # NaN fails the comparisons.
    near = (np.abs(body_pos) < DIVERGED_BEYOND_M).all((1, 2))
    return np.asarray(near & (np.abs(body_mat) < 2.0).all((1, 2, 3)))


def _placed(images: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Images (W, ...) of all worlds, from those of the worlds ``rows`` (W,) bool; zeros for the others."""
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
        self._model = sim.model(sim.layout.pack.homes[0].name)
        self.scene = build_render_scene(sim.layout, self._model)
        self.rasterizer = Rasterizer(self.scene, num_threads)
        self._home_index = {home.name: i for i, home in enumerate(sim.layout.pack.homes)}
        self._follow = FollowCamera(sim.model)
        self._mounts: dict[tuple[str, ...], _Mounts] = {}
        self.tracer: PathTracer | None = None
        if shading is not None:
            from mjhab.render.path_tracer.tracer import PathTracer  # of the extra photo

            self.tracer = PathTracer(self.scene, shading)

    def render(
        self,
        home: np.ndarray,
        body_pos: np.ndarray,
        body_mat: np.ndarray,
        cameras: Cameras,
        outputs: Sequence[str],
        quality: Literal["fast", "nice"] = "fast",
        looks: np.ndarray | None = None,
    ) -> dict[str, np.ndarray]:
        """As `Rasterizer.render`; colours are those of the path tracer if there is one, without ``looks``."""
        tracer = self.tracer if "rgb" in outputs else None
        drawn = set(outputs)
        if tracer is not None:
            drawn -= {"rgb"}
            drawn |= set(tracer.guides)
            looks = None
        images = {}
        if drawn:
            images = self.rasterizer.render(
                home, body_pos, body_mat, cameras, sorted(drawn), quality, looks=looks
            )
        if tracer is not None:
            images["rgb"] = tracer.render(
                home, body_pos, body_mat, cameras, images, quality
            )
        return {name: images[name] for name in outputs}

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
            self._follow.look(home, state.robot_q[world, BASE]) for home, world in drawn
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
        )
        return _placed(images["rgb"][:, 0], sane)

    def home_view(self, home: str, view: str, width: int, height: int) -> np.ndarray:
        """Render a furnished home without objects, the robot in its parked pose.

        Args:
            home: name of the home.
            view: "top" (the whole floor from above) or "inside" (across the home, at a height of `INSIDE_HEIGHT`).
            width, height: of the image [px].

        Returns:
            (height, width, 3) uint8 sRGB.

        Raises:
            UsageError: unknown view or home.
        """
        if view not in VIEWS:
            raise unknown_name("view", view, VIEWS)
        if home not in self._home_index:
            raise unknown_name("home", home, self._home_index)
        spec = self.layout.pack.homes[self._home_index[home]]
        eye, target, fovy = (
            self._from_top(spec, width, height)
            if view == "top"
            else self._from_inside(spec)
        )
        model = self._sim.model(home)
        data = mujoco.MjData(model)
        data.qpos[self._sim.addresses.robot_q] = parked_robot_qpos(self.layout.robot)
        mujoco.mj_kinematics(model, data)
        mat = look_at(eye.tolist(), target.tolist())
        images = self.render(
            np.array([self._home_index[home]]),
            data.xpos[None],
            data.xmat.reshape(1, -1, 3, 3),
            Cameras(eye[None, None], mat[None, None], fovy, width, height),
            ("rgb",),
            "nice",
        )
        return images["rgb"][0, 0]

    @staticmethod
    def _from_top(
        home: Home, width: int, height: int
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """Camera position (3,), target (3,) [m] and vertical field of view [rad] that show a whole floor.

        The image is rotated by 90 deg if that makes the long side of the floor the long side of the image.
        """
        x0, y0, x1, y1 = home.floor
        size = np.array([x1 - x0, y1 - y0])
        up = np.array([0.0, 1.0])
        if (size[1] > size[0]) != (height > width):
            size = size[::-1]
            up = np.array([1.0, 0.0])
        fit = max(size[1], size[0] * height / width) / 2 * 1.15
        center = np.array([(x0 + x1) / 2, (y0 + y1) / 2, 0.0])
        return (
            center + np.append(-0.18 * fit * up, 2.6 + fit / np.tan(HOME_FOVY / 2)),
            center,
            HOME_FOVY,
        )

    def _from_inside(self, home: Home) -> tuple[np.ndarray, np.ndarray, float]:
        """Camera position (3,), target (3,) [m] and vertical field of view [rad] of the view from inside.

        Of free floor cells far from the middle, the one that sees most of the other cells is taken.
        """
        fmap = free_map(home, self.layout.pack, cell=0.25)
        floor = fmap.to_xy(np.argwhere(fmap.navigable(0.2)))
        middle = floor.mean(axis=0)
        places = floor[
            np.argsort(np.linalg.norm(floor - middle, axis=1))[-max(1, len(floor) // 3) :]
        ]
        places = places[:: max(1, len(places) // 40)]
        share = np.linspace(0.02, 0.8, 30)[:, None]
        seen = []
        for xy in places:
            eye = np.append(xy, INSIDE_HEIGHT)
            spots = np.column_stack([floor[::7], np.full(len(floor[::7]), 0.5)])
            rays = (eye + share[:, None] * (spots - eye)).reshape(-1, 3)
            free = (
                (sphere_box_distance(rays, self._follow.tall(home.name)) > 0.02)
                .all(axis=1)
                .reshape(len(share), -1)
            )
            seen.append(int(free.all(axis=0).sum()))
        eye = np.append(places[int(np.argmax(seen))], INSIDE_HEIGHT)
        return eye, np.append(middle, 0.5), 1.2
