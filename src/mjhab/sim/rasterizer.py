"""Images of homes on the CPU, with no graphics library: rgb, depth and segmentation of many worlds in threads."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from mjhab.core.errors import UsageError, unknown_name
from mjhab.sim.occlusion import ambient_occlusion
from mjhab.sim.raster_kernels import (
    Geometry,
    Lens,
    Pose,
    Scratch,
    draw,
    make_scratch,
    place_instances,
    read_depth,
    read_segments,
)
from mjhab.sim.render_scene import RenderScene
from mjhab.sim.shading import SHADOW_SLOPE, Lamps, Surface, shade, tone_curve

OUTPUTS = ("rgb", "depth", "seg")
NEAR = 0.01
"""Near plane [m], as the cameras of MS-HAB have it."""
SHADOW_SIZE = 512
SHADOW_MAPS_KEPT = 64
"""Shadow maps of still furniture kept in memory (1 MiB each)."""


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> np.ndarray:
    """Rotation (3, 3) of a camera at ``eye`` that looks at ``target`` (world, [m]), in MuJoCo convention.

    Columns are the camera's axes in the world: x right, y up, z backwards. Looking along ``up`` is allowed.
    """
    back = np.asarray(eye, float) - np.asarray(target, float)
    if np.linalg.norm(back) < 1e-9:
        raise UsageError("look_at: eye and target are the same point; give two different points.")
    back /= np.linalg.norm(back)
    right = np.cross(np.asarray(up, float), back)
    if np.linalg.norm(right) < 1e-6:
        right = np.cross((0.0, 1.0, 0.0) if abs(back[1]) < 0.9 else (1.0, 0.0, 0.0), back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back], axis=1)


class Rasterizer:
    """Draws a RenderScene. Thread-safe; results do not depend on the number of threads.

    Args:
        scene: meshes, instances and looks, shared by all worlds.
        num_threads: 0 means one per core.
        cull_backfaces: do not draw faces seen from behind (closed meshes need it off only for looks inside).
    """

    def __init__(self, scene: RenderScene, num_threads: int = 0, cull_backfaces: bool = True) -> None:
        self.scene = scene
        self.cull_backfaces = cull_backfaces
        self._geometry = _geometry(scene)
        self._smooth = np.ascontiguousarray((scene.corner_normals != scene.corner_normals[:, :1]).any((1, 2)))
        self._extent = (self._geometry.mesh_box[:, 1] - self._geometry.mesh_box[:, 0])[scene.instance_mesh]
        self._still = np.flatnonzero(scene.instance_body == 0).astype(np.int32)
        self._moving = np.flatnonzero(scene.instance_body != 0).astype(np.int32)
        self._all = np.arange(len(scene.instance_mesh), dtype=np.int32)
        self._looks = [
            np.ascontiguousarray(a, t)
            for a, t in (
                (scene.mat_color, np.float64),
                (scene.mat_color2, np.float64),
                (scene.mat_pattern, np.int32),
                (scene.mat_scale, np.float64),
                (scene.mat_gloss, np.float64),
            )
        ]
        self._tone = tone_curve()
        self._local = threading.local()
        self._lock = threading.Lock()
        self._shadows: OrderedDict[tuple[int, int], np.ndarray] = OrderedDict()
        self.num_threads = num_threads or os.cpu_count() or 1
        self._pool = ThreadPoolExecutor(self.num_threads, "raster") if self.num_threads > 1 else None

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
        cam_pos: np.ndarray,
        cam_mat: np.ndarray,
        fovy: ArrayLike,
        width: int,
        height: int,
        outputs: Sequence[str] = OUTPUTS,
        quality: Literal["fast", "nice"] = "fast",
        ssaa: int = 0,
    ) -> dict[str, np.ndarray]:
        """Draw C cameras in each of W worlds.

        Args:
            home: (W,) home index of each world.
            body_pos, body_mat: (W, B, 3) [m] and (W, B, 3, 3) (or (W, B, 9)) world poses of the model's bodies.
            cam_pos, cam_mat: (W, C, 3) [m] and (W, C, 3, 3) (or (W, C, 9)); a camera looks along its -z, +y is up.
            fovy: vertical field of view [rad], one number or one per camera.
            width, height: image size [px].
            outputs: any of "rgb", "depth", "seg".
            quality: "fast" for observations; "nice" for people: lamp shadows, ambient occlusion, ssaa 2.
            ssaa: samples per pixel side of rgb; 0 means what ``quality`` says. Depth and seg are never smoothed.

        Returns:
            "rgb" (W, C, H, W, 3) uint8 sRGB; "depth" (W, C, H, W) float32 planar distance [m], 0 where nothing is;
            "seg" (W, C, H, W) int32 ids (names: ``scene.seg_names``), 0 where nothing is.

        Raises:
            UsageError: unknown output or quality, shapes that do not fit together.
        """
        _check_names(outputs, quality)
        home = np.asarray(home, np.int64)
        cam_pos = _array(cam_pos, (len(home), -1, 3), "cam_pos")
        cam_mat = _array(cam_mat, (len(home), cam_pos.shape[1], 3, 3), "cam_mat")
        body_pos = _array(body_pos, (len(home), -1, 3), "body_pos")
        body_mat = _array(body_mat, (len(home), body_pos.shape[1], 3, 3), "body_mat")
        self._check(home, body_pos.shape[1], width, height)
        fovy = np.broadcast_to(np.asarray(fovy, np.float64), (cam_pos.shape[1],))
        shape = (*cam_pos.shape[:2], height, width)
        kinds = {"rgb": ((*shape, 3), np.uint8), "depth": (shape, np.float32), "seg": (shape, np.int32)}
        images = {name: np.empty(kinds[name][0], kinds[name][1]) for name in outputs}
        samples = ssaa or (2 if quality == "nice" else 1)

        def one(job: tuple[int, int]) -> None:
            w, c = job
            lens = Lens(cam_pos[w, c], cam_mat[w, c], 0.5 * height / np.tan(0.5 * fovy[c]), NEAR)
            views = {name: image[w, c] for name, image in images.items()}
            self._draw(int(home[w]), body_pos[w], body_mat[w], lens, height, width, views, quality == "nice", samples)

        jobs = [(w, c) for w in range(shape[0]) for c in range(shape[1])]
        for _ in map(one, jobs) if self._pool is None or len(jobs) == 1 else self._pool.map(one, jobs):
            pass
        return images

    def _check(self, home: np.ndarray, bodies: int, width: int, height: int) -> None:
        homes = len(self.scene.home_pos)
        if len(home) and (home.min() < 0 or home.max() >= homes):
            raise UsageError(f"home must be in 0..{homes - 1}; got {home.min()}..{home.max()}.")
        needed = int(self.scene.instance_body.max(initial=0)) + 1
        if bodies < needed:
            raise UsageError(f"body_pos must have at least {needed} bodies (the scene names body {needed - 1}).")
        if width < 1 or height < 1:
            raise UsageError(f"width and height must be positive; got {width} x {height}.")

    def _draw(
        self,
        home: int,
        body_pos: np.ndarray,
        body_mat: np.ndarray,
        lens: Lens,
        height: int,
        width: int,
        views: dict[str, np.ndarray],
        nice: bool,
        samples: int,
    ) -> None:
        """Draw one camera of one world into ``views``."""
        pose = self._pose(home, body_pos, body_mat)
        if samples > 1 and "rgb" in views:
            fine = lens._replace(focal=lens.focal * samples)
            self._shade(home, pose, fine, *self._trace(pose, fine, height * samples, width * samples), views, nice)
            views = {name: view for name, view in views.items() if name != "rgb"}
        if not views:
            return
        inverse, ids = self._trace(pose, lens, height, width)
        if "depth" in views:
            read_depth(inverse, views["depth"])
        if "seg" in views:
            read_segments(inverse, ids, self.scene.instance_seg, views["seg"])
        if "rgb" in views:
            self._shade(home, pose, lens, inverse, ids, views, nice)

    def _scratch(self, name: str, shape: tuple[int, ...], dtype: type) -> np.ndarray:
        """An uninitialised array of this thread that is reused from call to call."""
        store = self._local.__dict__
        size = int(np.prod(shape))
        if name not in store or store[name].size < size or store[name].dtype != dtype:
            store[name] = np.empty(size, dtype)
        return store[name][:size].reshape(shape)

    def _pose(self, home: int, body_pos: np.ndarray, body_mat: np.ndarray) -> Pose:
        scene, count = self.scene, len(self._all)
        rot, pos = self._scratch("rot", (count, 3, 3), np.float64), self._scratch("pos", (count, 3), np.float64)
        place_instances(
            scene.instance_body, scene.instance_pos, scene.instance_mat,
            scene.home_pos[home], scene.home_mat[home], body_pos, body_mat, rot, pos,
        )  # fmt: skip
        return Pose(rot, pos, scene.home_scale[home])

    def _trace(self, pose: Pose, lens: Lens, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
        """Inverse depth and ids (height, width) of everything, in this thread's scratch."""
        inverse = self._scratch("inverse", (height, width), np.float32)
        ids = self._scratch("ids", (height, width), np.int64)
        inverse[:] = 0.0
        draw(self._geometry, self._all, pose, lens, self.cull_backfaces, inverse, ids, self._room())
        return inverse, ids

    def _room(self) -> Scratch:
        """This thread's scratch of the drawing kernel."""
        if not hasattr(self._local, "room"):
            self._local.room = make_scratch(self._geometry)
        return self._local.room

    def _shade(
        self,
        home: int,
        pose: Pose,
        lens: Lens,
        inverse: np.ndarray,
        ids: np.ndarray,
        views: dict[str, np.ndarray],
        nice: bool,
    ) -> None:
        scene, rgb = self.scene, views["rgb"]
        share = depths = np.empty((0, 0), np.float32)
        shadow = np.empty((0, 1, 1), np.float32)
        if nice:
            step = 2 * (inverse.shape[0] // rgb.shape[0])
            cells = (-(-inverse.shape[0] // step), -(-inverse.shape[1] // step))
            raw, share, depths = (self._scratch(n, cells, np.float32) for n in ("raw", "share", "depths"))
            ambient_occlusion(inverse, step, lens.focal, raw, share, depths)
            shadow = self._lamp_maps(home, pose)
        surface = Surface(
            scene.vertices, scene.faces, scene.corner_normals, self._smooth, scene.face_material,
            scene.instance_material[home], self._extent * np.abs(pose.scale), *self._looks,
        )  # fmt: skip
        lamps = Lamps(scene.light_pos[home], scene.light_color[home], shadow)
        shade(surface, pose, lamps, lens, inverse, ids, share, depths, self._tone, np.empty((3, 6)), rgb)

    def _lamp_maps(self, home: int, pose: Pose) -> np.ndarray:
        """Inverse depths (L, S, S) below every lamp: still furniture from the cache, moving bodies on top."""
        scene = self.scene
        maps = self._scratch("shadow", (scene.light_pos.shape[1], SHADOW_SIZE, SHADOW_SIZE), np.float32)
        ids = self._scratch("shadow_ids", (SHADOW_SIZE, SHADOW_SIZE), np.int64)
        focal = 0.5 * SHADOW_SIZE * SHADOW_SLOPE / np.sqrt(1.0 - SHADOW_SLOPE**2)
        for k, color in enumerate(scene.light_color[home]):
            if not color.any():
                continue
            lens = Lens(scene.light_pos[home, k], np.eye(3), focal, 0.05)
            with self._lock:
                still = self._shadows.get((home, k))
            if still is None:
                still = np.zeros((SHADOW_SIZE, SHADOW_SIZE), np.float32)
                draw(self._geometry, self._still, pose, lens, False, still, ids, self._room())
                with self._lock:
                    self._shadows[(home, k)] = still
                    while len(self._shadows) > SHADOW_MAPS_KEPT:
                        self._shadows.popitem(last=False)
            maps[k] = still
            draw(self._geometry, self._moving, pose, lens, False, maps[k], ids, self._room())
        return maps


def _check_names(outputs: Sequence[str], quality: str) -> None:
    for name in outputs:
        if name not in OUTPUTS:
            raise unknown_name("output", name, OUTPUTS)
    if quality not in ("fast", "nice"):
        raise unknown_name("quality", quality, ("fast", "nice"))


def _array(value: np.ndarray, shape: tuple[int, ...], name: str) -> np.ndarray:
    """``value`` as contiguous f64 of ``shape`` (-1: free), or a UsageError that names it."""
    array = np.asarray(value, np.float64)
    if array.ndim == len(shape) - 1 and shape[-2:] == (3, 3) and array.shape[-1] == 9:
        array = array.reshape(*array.shape[:-1], 3, 3)
    if array.ndim != len(shape) or any(want not in (-1, got) for want, got in zip(shape, array.shape, strict=True)):
        raise UsageError(f"{name} must have shape {shape} (-1: any); got {array.shape}.")
    return np.ascontiguousarray(array)


def _geometry(scene: RenderScene) -> Geometry:
    """Kernel view of the meshes: vertex ranges and bounding boxes from the faces of each mesh."""
    spans = np.stack([scene.mesh_face_start, scene.mesh_face_count], 1).astype(np.int32)
    verts = np.zeros_like(spans)
    box = np.zeros((len(spans), 2, 3))
    for k, (start, count) in enumerate(spans):
        used = scene.faces[start : start + count]
        if count == 0:
            continue
        verts[k] = used.min(), used.max() - used.min() + 1
        corners = scene.vertices[np.unique(used)]
        box[k] = corners.min(0), corners.max(0)
    return Geometry(scene.vertices, scene.faces, spans, verts, box, scene.instance_mesh)
