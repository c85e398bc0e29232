"""Rasterizer of rgb, depth and segmentation images of many worlds on the CPU, multi-threaded, without OpenGL."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Literal, NamedTuple

import numpy as np

from mjhab.core.errors import unknown_name
from mjhab.core.kernels.arrays import read_only
from mjhab.core.machine import cores
from mjhab.core.typed.checks import check, check_least, check_shape
from mjhab.render.cameras import LEVEL_ERROR, Cameras
from mjhab.render.lanes import LANES, z_buffer
from mjhab.render.raster.arrays import Bodies, Lens, make_scratch
from mjhab.render.raster.batch import ThreadBuffers, ViewBatch, draw_worlds
from mjhab.render.raster.kernels import draw, read_depth, read_segments
from mjhab.render.raster.lighting import SHADOW_SLOPE
from mjhab.render.raster.nodes import Openness
from mjhab.render.raster.occlusion import ambient_occlusion, make_cells
from mjhab.render.raster.scenery import make_scenery
from mjhab.render.raster.shading import make_shade_scratch, shade
from mjhab.render.raster.sight import place_balls
from mjhab.render.render_scene import RenderScene

OUTPUTS = ("rgb", "depth", "seg")
NEAR = 0.01
"""Near plane [m], as in the cameras of MS-HAB."""
SHADOW_SIZE = 512
"""Side of a shadow map [texels]."""
SHADOW_MAPS_KEPT = 64
"""Number of cached shadow maps of static furniture (1 MiB each)."""


class Quality(NamedTuple):
    """How images are drawn.

    Attributes:
        shadows: whether lamps cast shadows.
        samples: samples of rgb per pixel side.
        cell: side of a cell of ambient occlusion [px].
        stride: samples between the points of a run on one face at which light is computed.
    """

    shadows: bool
    samples: int
    cell: int
    stride: int


QualityName = Literal["fast", "film", "nice"]
FAST: QualityName = "fast"
FILM: QualityName = "film"
NICE: QualityName = "nice"
QUALITIES = {
    FAST: Quality(False, 1, 4, 8),
    FILM: Quality(True, 1, 4, 4),
    NICE: Quality(True, 2, 2, 1),
}
"""For observations, for films, and for pictures that people look at for long."""
ALL = 0
"""``which`` of `kernels.draw`: all instances."""
STILL = 1
"""``which`` of `kernels.draw`: instances attached to the world."""
MOVING = 2
"""``which`` of `kernels.draw`: instances attached to bodies."""
SIZES_KEPT = 6
"""Number of image sizes for which a thread keeps buffers."""


class _Picture(NamedTuple):
    """Size of an image [px], and how it is drawn."""

    height: int
    width: int
    quality: Quality


class _Shot(NamedTuple):
    """Content of one image: home index, materials and bodies of a world, and a camera."""

    home: int
    looks: np.ndarray
    bodies: Bodies
    lens: Lens


class Rasterizer:
    """Render a `RenderScene`. Thread-safe; results do not depend on the number of threads.

    Args:
        scene: meshes, instances and materials, shared by all worlds.
        num_threads: number of threads; 0 uses one per core.
        cull_backfaces: do not draw back faces. False is needed only for cameras inside of closed meshes.

    Raises:
        UsageError: the scene has more instances, or faces in a mesh, than the id of a pixel can hold.
    """

    def __init__(
        self, scene: RenderScene, num_threads: int = 0, cull_backfaces: bool = True
    ) -> None:
        self.scene = scene
        self.cull_backfaces = cull_backfaces
        self._scenery = make_scenery(scene)
        self._local = threading.local()
        self._lock = threading.Lock()
        self._shadows: OrderedDict[tuple[int, int], np.ndarray] = OrderedDict()
        self.num_threads = num_threads or cores()
        self._pool = (
            ThreadPoolExecutor(self.num_threads, "raster")
            if self.num_threads > 1
            else None
        )

    def close(self) -> None:
        """Stop the threads."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None

    def render(
        self,
        home: np.ndarray,
        body_pos: np.ndarray,
        body_mat: np.ndarray,
        cameras: Cameras,
        outputs: Sequence[str] = OUTPUTS,
        quality: QualityName = FAST,
        ssaa: int = 0,
        looks: np.ndarray | None = None,
    ) -> dict[str, np.ndarray]:
        """Render C cameras in each of W worlds.

        Args:
            home: (W,) index of each world's home.
            body_pos, body_mat: (W, B, 3) [m] and (W, B, 3, 3) (or (W, B, 9)) world poses of the model's bodies.
            cameras: C of each world.
            outputs: any of "rgb", "depth", "seg".
            quality: "fast" for observations: ambient occlusion on a coarse grid, lamps without shadows; for people
                "film", with the shadows of lamps, and "nice", with fine ambient occlusion and ssaa 2, too.
            ssaa: rgb samples per pixel side (supersampling); 0 takes that of ``quality``. Depth and seg have one sample
                per pixel.
            looks: (W, M), the material that each of the M of the scene is drawn as; None for its own.

        Returns:
            "rgb" (W, C, height, width, 3) uint8 sRGB; "depth" (W, C, height, width) float32 planar distance [m], 0 for
            background; "seg" (W, C, height, width) int32 ids (names: ``scene.seg_names``), 0 for background.

        Raises:
            UsageError: unknown output or quality; shapes that do not fit together; a camera that is not finite;
                home index, material or size out of range.
        """
        _check_names(outputs, quality)
        home = read_only(home, np.int64)
        width = cameras.width
        height = cameras.height
        cam_pos = _array(cameras.pos, (len(home), -1, 3), "cam_pos")
        cam_mat = _array(cameras.mat, (len(home), cam_pos.shape[1], 3, 3), "cam_mat")
        # The kernels have no bounds checks: a camera at NaN ends the process.
        for name, value in (("cam_pos", cam_pos), ("cam_mat", cam_mat)):
            check(bool(np.isfinite(value).all()), name, value, "finite")
        body_pos = _array(body_pos, (len(home), -1, 3), "body_pos")
        body_mat = _array(body_mat, (len(home), body_pos.shape[1], 3, 3), "body_mat")
        self._check(home, body_pos.shape[1], width, height)
        fovy = np.asarray(cameras.fovy, np.float64)
        focal = np.broadcast_to(0.5 * height / np.tan(0.5 * fovy), cam_pos.shape[:2])
        how = QUALITIES[quality]
        if ssaa:
            how = how._replace(samples=ssaa)
        views = ViewBatch(
            home,
            self._looks(looks, len(home)),
            body_pos,
            body_mat,
            cam_pos,
            cam_mat,
            read_only(focal),
            float(cameras.level_error),
            **_images((len(home), cam_pos.shape[1], height, width), outputs),
        )
        if how.shadows or how.samples > 1:
            jobs = [(w, c) for w in range(len(home)) for c in range(cam_pos.shape[1])]
            picture = _Picture(height, width, how)
            self._each(lambda job: self._draw(views, *job, picture), jobs)
        else:
            self._draw_fast(views, height, width)
        return {name: getattr(views, name) for name in outputs}

    def _each(
        self, work: Callable[[tuple[int, int]], None], jobs: list[tuple[int, int]]
    ) -> None:
        for _ in (
            map(work, jobs)
            if self._pool is None or len(jobs) == 1
            else self._pool.map(work, jobs)
        ):
            pass

    def _draw_fast(self, views: ViewBatch, height: int, width: int) -> None:
        """Render all cameras of all worlds: the calling thread and those of the pool take one world after the other.

        Where threads are more than worlds, they take one camera after the other.
        """
        turn = np.zeros(1, np.int64)
        worlds, cameras = views.focal.shape
        if not worlds * cameras:
            return
        together = cameras if worlds >= self.num_threads else 1
        threads = min(self.num_threads, worlds * cameras // together)
        futures = []
        if self._pool is not None:
            futures = [
                self._pool.submit(self._draw_parts, views, turn, together, height, width)
                for _ in range(threads - 1)
            ]
        self._draw_parts(views, turn, together, height, width)
        for future in futures:
            future.result()

    def _draw_parts(
        self, views: ViewBatch, turn: np.ndarray, together: int, height: int, width: int
    ) -> None:
        """Render the parts of the work that this thread takes, see `draw_worlds`."""
        buffers = self._buffers(height, width, QUALITIES[FAST].cell)
        draw_worlds(
            self._scenery,
            views,
            turn,
            together,
            NEAR,
            self.cull_backfaces,
            QUALITIES[FAST].cell,
            QUALITIES[FAST].stride,
            buffers,
        )

    def _check(self, home: np.ndarray, bodies: int, width: int, height: int) -> None:
        homes = len(self.scene.home_pos)
        check(
            not len(home) or (home.min() >= 0 and home.max() < homes),
            "home",
            home,
            f"in 0..{homes - 1}",
        )
        needed = int(self.scene.instance_body.max(initial=0)) + 1
        check_least("number of bodies of body_pos", bodies, needed)
        check(
            width >= 1 and height >= 1, "width and height", (width, height), "at least 1"
        )

    def _looks(self, looks: np.ndarray | None, worlds: int) -> np.ndarray:
        """(W, M) i32 materials of the scene's materials, checked: the kernels have no bounds checks."""
        count = len(self.scene.mat_color)
        if looks is None:
            looks = np.broadcast_to(np.arange(count), (worlds, count))
        looks = read_only(looks, np.int32)
        check_shape("looks", looks, (worlds, count))
        good = not looks.size or (looks.min() >= 0 and looks.max() < count)
        check(good, "looks", looks, f"in 0..{count - 1}")
        return looks

    def _draw(self, views: ViewBatch, w: int, c: int, picture: _Picture) -> None:
        """Render camera ``c`` of world ``w``."""
        height = picture.height
        width = picture.width
        samples = picture.quality.samples
        cell = picture.quality.cell
        bodies = Bodies(views.body_pos[w], views.body_mat[w])
        lens = Lens(
            views.cam_pos[w, c],
            views.cam_mat[w, c],
            float(views.focal[w, c]),
            NEAR,
            views.level_error,
        )
        shot = _Shot(int(views.home[w]), views.looks[w], bodies, lens)
        fine = views.rgb.shape[1] > 0 and samples > 1
        if fine:
            buffers = self._buffers(height * samples, width * samples, cell * samples)
            large = shot._replace(lens=lens._replace(focal=lens.focal * samples))
            self._trace(large, buffers)
            self._shade(large, buffers, views.rgb[w, c], picture)
        buffers = self._buffers(height, width, cell)
        if views.depth.shape[1] or views.seg.shape[1] or not fine:
            self._trace(shot, buffers)
        if views.depth.shape[1]:
            read_depth(buffers.inverse, views.depth[w, c])
        if views.seg.shape[1]:
            read_segments(
                buffers.inverse, buffers.ids, self._scenery.seg, views.seg[w, c]
            )
        if views.rgb.shape[1] and not fine:
            self._shade(shot, buffers, views.rgb[w, c], picture)

    def _buffers(self, height: int, width: int, cell: int) -> ThreadBuffers:
        """This thread's buffers for an image size [px] and a side of ambient-occlusion cells [px]."""
        kept = self._local.__dict__.setdefault("buffers", OrderedDict())
        key = (height, width, cell)
        if key not in kept:
            count = len(self.scene.instance_mesh)
            flat = np.zeros(height * width + LANES, np.float32)
            kept[key] = ThreadBuffers(
                make_scratch(self._scenery.geometry, count),
                make_shade_scratch(count, width),
                flat[: height * width].reshape(height, width),
                z_buffer((height, width), np.int32),
                flat,
                make_cells(-(-height // cell), -(-width // cell)),
            )
            if len(kept) > SIZES_KEPT:
                kept.popitem(last=False)
        return kept[key]

    def _trace(self, shot: _Shot, buffers: ThreadBuffers) -> None:
        """Rasterise all instances into the thread's z-buffer."""
        buffers.inverse[:] = 0.0
        place_balls(self._scenery.placing, shot.home, shot.bodies, buffers.draw)
        self._draw_instances(shot, ALL, buffers.inverse, buffers.ids, buffers)

    def _draw_instances(
        self,
        shot: _Shot,
        which: int,
        inverse: np.ndarray,
        ids: np.ndarray,
        buffers: ThreadBuffers,
    ) -> None:
        s = self._scenery
        cull = self.cull_backfaces and which == ALL
        draw(
            s.geometry,
            s.placing,
            shot.home,
            which,
            shot.bodies,
            shot.lens,
            cull,
            inverse,
            ids,
            buffers.draw,
        )

    def _shade(
        self, shot: _Shot, buffers: ThreadBuffers, rgb: np.ndarray, picture: _Picture
    ) -> None:
        s = self._scenery
        lens = shot.lens
        how = picture.quality
        cell = how.cell * how.samples
        lamps = s.lamps
        openness = Openness(buffers.cells.share, buffers.cells.depths, 1.0 / cell)
        ambient_occlusion(buffers.inverse, buffers.flat, cell, lens.focal, buffers.cells)
        if how.shadows:
            drawn = buffers.draw.drawn.copy()
            lamps = lamps._replace(shadow=self._lamp_maps(shot, buffers))
            buffers.draw.drawn[:] = drawn
        shade(
            s.surface,
            buffers.draw,
            lamps,
            shot.home,
            shot.looks,
            lens,
            buffers.inverse,
            buffers.ids,
            openness,
            s.tone,
            buffers.shade,
            how.stride,
            rgb,
        )

    def _lamp_maps(self, shot: _Shot, buffers: ThreadBuffers) -> np.ndarray:
        """Shadow maps (L, S, S) f32 of a home's lamps: static furniture from the cache, bodies drawn on top."""
        scene = self.scene
        home = shot.home
        side = SHADOW_SIZE
        maps = z_buffer((scene.light_pos.shape[1], side, side), np.float32)
        ids = z_buffer((side, side), np.int32)
        focal = 0.5 * SHADOW_SIZE * SHADOW_SLOPE / np.sqrt(1.0 - SHADOW_SLOPE**2)
        for k, color in enumerate(scene.light_color[home]):
            if not color.any():
                continue
            place = read_only(scene.light_pos[home, k])
            lens = Lens(place, read_only(np.eye(3)), float(focal), 0.05, LEVEL_ERROR)
            below = shot._replace(lens=lens)
            with self._lock:
                still = self._shadows.get((home, k))
            if still is None:
                still = z_buffer((side, side), np.float32)
                self._draw_instances(below, STILL, still, ids, buffers)
                with self._lock:
                    self._shadows[(home, k)] = still
                    while len(self._shadows) > SHADOW_MAPS_KEPT:
                        self._shadows.popitem(last=False)
            maps[k] = still
            self._draw_instances(below, MOVING, maps[k], ids, buffers)
        return maps


def _check_names(outputs: Sequence[str], quality: str) -> None:
    for name in outputs:
        if name not in OUTPUTS:
            raise unknown_name("output", name, OUTPUTS)
    if quality not in QUALITIES:
        raise unknown_name("quality", quality, QUALITIES)


def _array(value: np.ndarray, shape: tuple[int, ...], name: str) -> np.ndarray:
    """``value`` as a contiguous read-only f64 array of ``shape`` (-1: any), else a UsageError with its ``name``."""
    array = np.asarray(value, np.float64)
    if array.ndim == len(shape) - 1 and shape[-2:] == (3, 3) and array.shape[-1] == 9:
        array = array.reshape(*array.shape[:-1], 3, 3)
    check_shape(name, array, shape)
    return read_only(array)


def _images(
    shape: tuple[int, int, int, int], outputs: Sequence[str]
) -> dict[str, np.ndarray]:
    """Uninitialised images of ``shape`` (W, C, h, w) by output; with C 0 for outputs not requested."""
    worlds, cameras, height, width = shape
    kinds = {"rgb": (np.uint8, (3,)), "depth": (np.float32, ()), "seg": (np.int32, ())}
    return {
        name: np.empty(
            (worlds, cameras if name in outputs else 0, height, width, *tail), kind
        )
        for name, (kind, tail) in kinds.items()
    }
