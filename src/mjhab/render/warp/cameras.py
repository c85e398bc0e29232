"""Images of the robot's cameras in all worlds of a `WarpSimulator`, rendered on its device.

They show the same render scene as the CPU renderer, with the same light and textures, but by ray casting instead of
rasterization: depth and segmentation agree, colours nearly so (lamps without shadows and ambient occlusion in screen
space, as on the CPU).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
import warp as wp

from mjhab.core.errors import fault, unknown_name
from mjhab.core.rotations import mat_from_quat
from mjhab.core.typed.checks import check
from mjhab.render.layout_scene import build_render_scene
from mjhab.render.raster.rasterizer import FAST, NEAR, OUTPUTS, QUALITIES
from mjhab.render.warp import occlusion as warp_occlusion
from mjhab.render.warp import shading as warp_shading
from mjhab.render.warp import tracing as warp_tracing
from mjhab.render.warp.scene import DeviceScene
from mjhab.sim.warp.device import room_for, set_up
from mjhab.sim.warp.graphs import Graphs
from mjhab.sim.warp.simulator import WarpSimulator

WORLDS_AT_ONCE = 256
"""Number of worlds rendered together. It bounds the memory of intermediate results and still fills any GPU."""


class WarpCameras:
    """Render robot cameras of all W worlds. A world may move to another home between two calls.

    Attributes:
        segmentation_names: name of every segment id, as ``scene.seg_names`` of `HomeRenderer`.

    Args:
        sim: the worlds.
        cameras: names of robot cameras, in the order of the axis C.
        size: height and width of the images [px].
        outputs: any of "rgb", "depth", "seg".

    Raises:
        UsageError: a camera or output is unknown, or none is given; a size is below 1; or the device has no room for
            the images.
    """

    def __init__(
        self,
        sim: WarpSimulator,
        cameras: Sequence[str],
        size: tuple[int, int],
        outputs: Sequence[str],
    ) -> None:
        _check(sim.layout.robot.camera_names, cameras, size, outputs)
        self._sim = sim
        self._cameras = tuple(cameras)
        self._size = size
        self._outputs = tuple(outputs)
        homes = sim.layout.pack.homes
        self._home_index = {home.name: i for i, home in enumerate(homes)}
        model = sim.model(homes[0].name)
        scene = build_render_scene(sim.layout, model)
        self.segmentation_names = scene.seg_names
        self._graphs = Graphs(sim.device)
        self._rows = wp.from_torch(sim.engine.homes.rows)
        self._rows_known = 0
        with room_for(sim.num_worlds, sim.device), set_up(sim.device):
            self._scene = DeviceScene(scene)
            self._home_of_row = wp.zeros(len(homes), dtype=wp.int32)
            self._mount(model)
            self._worlds = self._make_worlds()
            self._frame = self._make_frame()
            self._cells = self._make_cells()
            self._images = self._make_images()
        self._views = {name: wp.to_torch(self._images[name]) for name in self._outputs}
        self._pos = wp.to_torch(self._worlds.cam_pos)
        self._mat = wp.to_torch(self._worlds.cam_mat)
        self._wanted = wp.to_torch(self._worlds.wanted)

    def draw(self, only: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
        """Render the current state; returns the images by output, which the next call overwrites.

        Args:
            only: (W,) bool on the device, worlds to render; the others keep their images. None renders all.

        Returns:
            "depth" (W, C, height, width) float32 planar distance [m], 0 where nothing is hit; "rgb" (W, C, height,
            width, 3) uint8 sRGB; "seg" (W, C, height, width) int32 ids. A world whose physics has diverged gets zeros.

        Raises:
            UsageError: the device has no room for the scene of a home.
        """
        if only is None:
            self._wanted.fill_(True)
        else:
            self._wanted.copy_(only)
        with room_for(self._sim.num_worlds, self._sim.device):
            self._add_homes()
            with wp.ScopedDevice(self._sim.device):
                self._graphs.run("draw", self._draw)
        return dict(self._views)

    def poses(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Compute the world poses of the cameras in the current state.

        Returns:
            Positions (W, C, 3) [m] and orientations (W, C, 3, 3), whose columns are the camera's axes (x right, y up, z
            backwards); float32 on the device. The next call overwrites them.
        """
        with wp.ScopedDevice(self._sim.device):
            self._graphs.run("poses", self._place_cameras)
        return self._pos, self._mat

    def _mount(self, model: Any) -> None:
        mounts = [self._sim.layout.robot.camera(name) for name in self._cameras]
        bodies = np.array([model.body(mount.body).id for mount in mounts], np.int32)
        mats = mat_from_quat(np.array([mount.quat for mount in mounts]))
        self._mount_body = wp.array(bodies, dtype=wp.int32)
        self._mount_pos = wp.array(
            np.array([mount.pos for mount in mounts], np.float32), dtype=wp.vec3
        )
        self._mount_mat = wp.array(mats.astype(np.float32), dtype=wp.mat33)
        fovy = np.array([mount.fovy for mount in mounts])
        self._focal = wp.array(
            (0.5 * self._size[0] / np.tan(0.5 * fovy)).astype(np.float32),
            dtype=wp.float32,
        )

    def _make_worlds(self) -> Any:
        worlds = warp_tracing.TracedWorlds()
        count = self._sim.num_worlds
        movers = len(self._scene.movers.body)
        cameras = len(self._cameras)
        worlds.home = wp.zeros(count, dtype=wp.int32)
        worlds.sane = wp.zeros(count, dtype=wp.bool)
        worlds.wanted = wp.ones(count, dtype=wp.bool)
        worlds.pos, worlds.mat = (
            wp.zeros((count, movers), dtype=kind) for kind in (wp.vec3, wp.mat33)
        )
        worlds.cam_pos, worlds.cam_mat = (
            wp.zeros((count, cameras), dtype=kind) for kind in (wp.vec3, wp.mat33)
        )
        return worlds

    def _make_frame(self) -> Any:
        frame = warp_tracing.TracedFrame()
        (height, width) = self._size
        self._chunk = min(WORLDS_AT_ONCE, self._sim.num_worlds)
        tile = warp_tracing.TILE
        rows = -(-height // tile)
        columns = -(-width // tile)
        self._tiles = rows * columns
        frame.focal = self._focal
        frame.width = width
        frame.height = height
        frame.columns = columns
        frame.near = NEAR
        shape = (self._chunk, len(self._cameras), self._tiles)
        frame.listed = wp.zeros(shape, dtype=wp.int32)
        frame.movers = wp.zeros(
            (*shape, max(1, len(self._scene.movers.body))), dtype=wp.int16
        )
        colored = (
            self._chunk,
            len(self._cameras) if "rgb" in self._outputs else 0,
            height * width,
        )
        frame.inverse = wp.zeros(colored, dtype=wp.float32)
        frame.ids = wp.zeros(colored, dtype=wp.int32)
        return frame

    def _make_cells(self) -> Any:
        cells = warp_occlusion.Cells()
        (height, width) = self._size
        cells.cell = QUALITIES[FAST].cell
        cells.width = -(-width // QUALITIES[FAST].cell)
        cells.height = -(-height // QUALITIES[FAST].cell)
        shape = (
            self._chunk,
            len(self._cameras) if "rgb" in self._outputs else 0,
            cells.width * cells.height,
        )
        cells.raw, cells.share, cells.depths = (
            wp.zeros(shape, dtype=wp.float32) for _ in range(3)
        )
        return cells

    def _make_images(self) -> dict[str, wp.array]:
        kinds = {"depth": wp.float32, "rgb": wp.vec3ub, "seg": wp.int32}
        worlds = self._sim.num_worlds
        cameras = len(self._cameras)
        return {
            name: wp.zeros(
                (worlds, cameras if name in self._outputs else 0, *self._size), dtype=kind
            )
            for name, kind in kinds.items()
        }

    def _add_homes(self) -> None:
        """Build the meshes of homes that the simulator has added since the last call."""
        names = self._sim.engine.homes.names
        if len(names) == self._rows_known:
            return
        with set_up(self._sim.device):
            for name in names[self._rows_known :]:
                self._scene.add_home(self._home_index[name])
            index = [self._home_index[name] for name in names]
            self._home_of_row[: len(index)].assign(np.array(index, np.int32))
        self._rows_known = len(names)

    def _place_cameras(self) -> None:
        data = self._sim.engine.data
        worlds = self._worlds
        wp.launch(
            warp_tracing.place_cameras,
            dim=worlds.cam_pos.shape,
            inputs=[
                self._mount_body,
                self._mount_pos,
                self._mount_mat,
                data.xpos,
                data.xmat,
                worlds,
            ],
        )

    def _draw(self) -> None:
        engine = self._sim.engine
        scene = self._scene
        worlds = self._worlds
        wp.launch(
            warp_tracing.find_homes,
            dim=self._sim.num_worlds,
            inputs=[self._rows, self._home_of_row, engine.data.xpos, worlds],
        )
        self._place_cameras()
        wp.launch(
            warp_tracing.place_movers,
            dim=worlds.pos.shape,
            inputs=[scene.movers, engine.data.xpos, engine.data.xmat, worlds],
        )
        for first in self.chunks:
            for stage in self.stages().values():
                stage(first)

    def stages(self) -> dict[str, Callable[[int], None]]:
        """What is launched for the worlds from a first one on, up to `WORLDS_AT_ONCE` of them, in its order.

        "list" finds the moving instances of every tile, "trace" casts the rays; with colours "occlude" finds what is
        hidden from the light about it, and "shade" colours the pixels. `draw` does all for all worlds.
        """
        stages = {"list": self._list_movers, "trace": self._trace}
        if "rgb" in self._outputs:
            stages |= {"occlude": self._occlude, "shade": self._shade}
        return stages

    @property
    def chunks(self) -> range:
        """First worlds of what is rendered together."""
        return range(0, self._sim.num_worlds, self._chunk)

    def _list_movers(self, first: int) -> None:
        scene = self._scene
        wp.launch(
            warp_tracing.list_movers,
            dim=(self._chunk, len(self._cameras), self._tiles),
            inputs=[scene.stills, scene.movers, self._worlds, self._frame, first],
        )

    def _trace(self, first: int) -> None:
        scene = self._scene
        rays = self._tiles * warp_tracing.TILE_PIXELS
        wp.launch(
            warp_tracing.trace,
            dim=(self._chunk, len(self._cameras), rays),
            inputs=[
                scene.stills,
                scene.movers,
                self._worlds,
                self._frame,
                scene.seg,
                first,
            ],
            outputs=[self._images["depth"], self._images["seg"]],
        )

    def _occlude(self, first: int) -> None:
        cells = self._cells
        spots = (self._chunk, len(self._cameras), cells.width * cells.height)
        wp.launch(
            warp_occlusion.block_cells,
            dim=spots,
            inputs=[self._scene.looks, self._worlds, self._frame, cells, first],
        )
        wp.launch(
            warp_occlusion.blur_cells, dim=spots, inputs=[self._worlds, cells, first]
        )

    def _shade(self, first: int) -> None:
        scene = self._scene
        frame = self._frame
        wp.launch(
            warp_shading.shade,
            dim=(self._chunk, len(self._cameras), frame.width * frame.height),
            inputs=[
                scene.looks,
                scene.stills,
                scene.movers,
                self._worlds,
                frame,
                self._cells,
                first,
            ],
            outputs=[self._images["rgb"]],
        )


def _check(
    mounted: Sequence[str],
    cameras: Sequence[str],
    size: tuple[int, int],
    outputs: Sequence[str],
) -> None:
    for kind, given, known in (
        ("camera", cameras, mounted),
        ("output", outputs, OUTPUTS),
    ):
        if not given:
            raise fault("WarpCameras", f"no {kind} given; known are {', '.join(known)}.")
        for name in given:
            if name not in known:
                raise unknown_name(kind, name, known)
    check(min(size) >= 1, "size", size, "positive", where="WarpCameras")


def _bytes(structs: Sequence[object]) -> int:
    """Memory of the arrays in Warp structs [bytes]."""
    arrays = [
        value
        for struct in structs
        for value in vars(struct).values()
        if isinstance(value, wp.array)
    ]
    return sum(array.size * wp.types.type_size_in_bytes(array.dtype) for array in arrays)
