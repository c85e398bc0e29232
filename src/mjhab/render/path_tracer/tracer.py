"""Colour pictures of many worlds by the path tracer, from the scene that the rasterizer draws."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from mjhab.render.cameras import Cameras
from mjhab.render.models import srgb_bytes
from mjhab.render.path_tracer.library import denoise, mitsuba
from mjhab.render.path_tracer.lights import TIMES
from mjhab.render.path_tracer.traced_home import PlacedHome, TracedHome
from mjhab.render.raster.rasterizer import NEAR
from mjhab.render.raster.shading import compressed
from mjhab.render.render_scene import RenderScene
from mjhab.scenes.shading import Shading
from mjhab.scenes.shapes.colors import srgb_to_linear

HOMES_KEPT = 8
"""Number of homes whose scenes are kept."""
GUIDES = ("rgb", "depth")
"""Pictures of the rasterizer that the denoiser is shown: textures and edges without noise. Samples of the surfaces by
Mitsuba take 10 us each, as much as two paths of light."""
SUN_SHARE = 4
"""Paths per pixel for every one that looks at the sun, which has no noise but at edges."""


class _TracedShot(NamedTuple):
    """A home and a sensor of Mitsuba, and whether the home has its ceiling."""

    home: PlacedHome
    sensor: Any
    roof: bool


class PathTracer:
    """Trace the light of a `RenderScene`. Pictures do not depend on the number of worlds.

    Args:
        scene: meshes, instances and materials, shared by all worlds.
        shading: samples, light and variant.

    Raises:
        UsageError: see `library.mitsuba`.
    """

    def __init__(self, scene: RenderScene, shading: Shading) -> None:
        self.scene = scene
        self.shading = shading
        self._mi: Any = mitsuba(shading.variant)
        self._light = TIMES[shading.light]
        # In the order of use: the one that was not drawn for longest is dropped first.
        self._homes: OrderedDict[int, TracedHome] = OrderedDict()
        self._distance = self._mi.load_dict({"type": "aov", "aovs": "depth:depth"})

    @property
    def guides(self) -> tuple[str, ...]:
        """Pictures of the rasterizer that `render` is to be given."""
        return GUIDES if self.shading.denoise else ()

    def render(
        self,
        home: np.ndarray,
        body_pos: np.ndarray,
        body_mat: np.ndarray,
        cameras: Cameras,
        guides: Mapping[str, np.ndarray],
        quality: str = "fast",
    ) -> np.ndarray:
        """Colours (W, C, height, width, 3) uint8 sRGB; arguments as `Rasterizer.render`.

        ``guides``: `self.guides` by the rasterizer.
        """
        shape = (*np.shape(cameras.pos)[:2], cameras.height, cameras.width, 3)
        images = np.empty(shape, np.uint8)
        for w, c in np.ndindex(*shape[:2]):
            shot = self._shot(home, body_pos, body_mat, cameras, (w, c), False)
            light = self._light_of(shot)
            if self.shading.denoise:
                # Normals from the depth of the rasterizer, which has no noise.
                slope = float(_slopes(cameras)[w, c])
                albedo = srgb_to_linear(guides["rgb"][w, c] / 255.0).astype(np.float32)
                normal = _normals(guides["depth"][w, c], slope, cameras.mat[w, c])
                light = denoise(light, albedo, normal, quality != "nice")
            exposure = self._light.exposure if shot.roof else self._light.open
            images[w, c] = srgb_bytes(compressed(exposure * np.asarray(light)))
        return images

    def depth(
        self,
        home: np.ndarray,
        body_pos: np.ndarray,
        body_mat: np.ndarray,
        cameras: Cameras,
    ) -> np.ndarray:
        """Planar distance (W, C, height, width) f32 [m] of what the centres of the pixels see, 0 for the sky."""
        shape = (*np.shape(cameras.pos)[:2], cameras.height, cameras.width)
        images = np.empty(shape, np.float32)
        slope = _slopes(cameras)
        u = (np.arange(cameras.width) + 0.5 - cameras.width / 2)[None]
        v = (np.arange(cameras.height) + 0.5 - cameras.height / 2)[:, None]
        for w, c in np.ndindex(*shape[:2]):
            along = 1.0 / np.sqrt(1.0 + slope[w, c] ** 2 * (u * u + v * v))
            shot = self._shot(home, body_pos, body_mat, cameras, (w, c), True)
            found = self._mi.render(
                shot.home.room,
                sensor=shot.sensor,
                integrator=self._distance,
                spp=1,
                seed=0,
            )
            far = np.array(found, np.float32)[..., 0]
            # Mitsuba's rays begin at the near plane.
            images[w, c] = np.where(far > 0.0, far * along + NEAR, 0.0)
        return images

    def _shot(
        self,
        home: np.ndarray,
        body_pos: np.ndarray,
        body_mat: np.ndarray,
        cameras: Cameras,
        which: tuple[int, int],
        centred: bool,
    ) -> _TracedShot:
        """What one picture is taken of; ``centred``: at the centres of the pixels alone."""
        w, c = which
        traced = self._home(int(home[w]))
        eye = np.asarray(cameras.pos[w, c], float)
        # A camera above the ceiling looks into rooms from above.
        roof = bool(eye[2] < traced.ceiling)
        placed = traced.placed(
            roof, np.asarray(body_pos[w]), np.asarray(body_mat[w]).reshape(-1, 3, 3)
        )
        fovy = float(_fields_of_view(cameras)[w, c])
        mat = np.asarray(cameras.mat[w, c], float).reshape(3, 3)
        return _TracedShot(placed, self._sensor(cameras, fovy, eye, mat, centred), roof)

    def _home(self, home: int) -> TracedHome:
        if home not in self._homes:
            self._homes[home] = TracedHome(self._mi, self.scene, home, self.shading)
            if len(self._homes) > HOMES_KEPT:
                self._homes.popitem(last=False)
        self._homes.move_to_end(home)
        return self._homes[home]

    def _sensor(
        self,
        cameras: Cameras,
        fovy: float,
        eye: np.ndarray,
        mat: np.ndarray,
        centred: bool,
    ) -> Any:
        place = self._mi.ScalarTransform4f().look_at(
            eye.tolist(), (eye - mat[:, 2]).tolist(), mat[:, 1].tolist()
        )
        sampler = {"type": "independent"}
        if centred:
            sampler = {"type": "stratified", "jitter": False, "sample_count": 1}
        return self._mi.load_dict(
            {
                "type": "perspective",
                "fov": float(np.degrees(fovy)),
                "fov_axis": "y",
                "near_clip": NEAR,
                "to_world": place,
                "sampler": sampler,
                "film": {
                    "type": "hdrfilm",
                    "width": cameras.width,
                    "height": cameras.height,
                    "component_format": "float32",
                    # The denoiser wants pixels whose noise does not depend on their neighbours'.
                    "rfilter": {"type": "box"},
                },
            }
        )

    def _light_of(self, shot: _TracedShot) -> np.ndarray:
        """Radiance (h, w, 3) f32."""
        samples = self.shading.samples
        light = self._traced(shot.home.room, shot.sensor, samples)
        if shot.home.sun is not None:
            few = max(samples // SUN_SHARE, 1)
            light += self._traced(shot.home.sun, shot.sensor, few)
        return light

    def _traced(self, scene: Any, sensor: Any, samples: int) -> np.ndarray:
        # The same seed for all, so that a picture does not depend on those drawn before.
        found = self._mi.render(scene, sensor=sensor, spp=samples, seed=0)
        return np.array(found, np.float32)


def _fields_of_view(cameras: Cameras) -> np.ndarray:
    """Vertical fields of view (W, C) [rad]."""
    return np.broadcast_to(np.asarray(cameras.fovy, float), np.shape(cameras.pos)[:2])


def _slopes(cameras: Cameras) -> np.ndarray:
    """Tangent of the angle of a pixel in the middle (W, C)."""
    return 2.0 * np.tan(0.5 * _fields_of_view(cameras)) / cameras.height


def _normals(depth: np.ndarray, slope: float, mat: np.ndarray) -> np.ndarray:
    """Unit normals (h, w, 3) f32 in the world of the surfaces at planar distances (h, w) [m].

    Args:
        slope: see `_slopes`.
        mat: (3, 3) orientation of the camera.
    """
    height, width = depth.shape
    u = slope * (np.arange(width) + 0.5 - width / 2)[None]
    v = slope * (height / 2 - np.arange(height) - 0.5)[:, None]
    point = np.stack([u * depth, v * depth, -depth], axis=-1)
    # Rows of an image run downwards.
    found = np.cross(np.gradient(point, axis=1), -np.gradient(point, axis=0))
    found /= np.maximum(np.linalg.norm(found, axis=-1, keepdims=True), 1e-12)
    return (found @ np.asarray(mat).reshape(3, 3).T).astype(np.float32)
