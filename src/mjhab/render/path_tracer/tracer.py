"""Colour pictures of many worlds by the path tracer, from the scene that the rasterizer draws."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any, NamedTuple

import numpy as np

from mjhab.render.models import srgb_bytes
from mjhab.render.path_tracer.library import denoise, mitsuba
from mjhab.render.path_tracer.lights import TIMES
from mjhab.render.path_tracer.traced_home import TracedHome
from mjhab.render.raster.rasterizer import NEAR, Cameras
from mjhab.render.raster.shading import compressed
from mjhab.render.render_scene import RenderScene
from mjhab.scenes.shading import Shading

HOMES_KEPT = 8
"""Number of homes whose scenes are kept."""
_SURFACES = "albedo:albedo,normal:sh_normal,depth:depth"
"""What is asked of the surfaces that are seen. A picture of its own: in that of the light each path would take thrice
the time (7 us of 10 us)."""
_ALBEDO = slice(0, 3)
_NORMAL = slice(3, 6)
_DEPTH = 6
MOST_SURFACES = 4
"""Samples per pixel of the surfaces, at most; a fourth of those of the light."""


class _TracedShot(NamedTuple):
    """A scene and a sensor of Mitsuba, and whether the scene has a ceiling."""

    scene: Any
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
        self._homes: OrderedDict[int, TracedHome] = OrderedDict()
        self._surfaces = self._mi.load_dict({"type": "aov", "aovs": _SURFACES})

    def render(
        self,
        home: np.ndarray,
        body_pos: np.ndarray,
        body_mat: np.ndarray,
        cameras: Cameras,
    ) -> np.ndarray:
        """Colours (W, C, height, width, 3) uint8 sRGB; arguments as `Rasterizer.render`."""
        shape = (*np.shape(cameras.pos)[:2], cameras.height, cameras.width, 3)
        images = np.empty(shape, np.uint8)
        for w, c in np.ndindex(*shape[:2]):
            shot = self._shot(home, body_pos, body_mat, cameras, (w, c), False)
            images[w, c] = self._developed(shot)
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
        slope = 2.0 * np.tan(0.5 * _fields_of_view(cameras)) / cameras.height
        u = (np.arange(cameras.width) + 0.5 - cameras.width / 2)[None]
        v = (np.arange(cameras.height) + 0.5 - cameras.height / 2)[:, None]
        for w, c in np.ndindex(*shape[:2]):
            along = 1.0 / np.sqrt(1.0 + slope[w, c] ** 2 * (u * u + v * v))
            shot = self._shot(home, body_pos, body_mat, cameras, (w, c), True)
            far = self._seen(shot, 1)[..., _DEPTH]
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
        roof = bool(eye[2] < traced.ceiling)
        scene = traced.placed(
            roof, np.asarray(body_pos[w]), np.asarray(body_mat[w]).reshape(-1, 3, 3)
        )
        fovy = float(_fields_of_view(cameras)[w, c])
        mat = np.asarray(cameras.mat[w, c], float).reshape(3, 3)
        return _TracedShot(scene, self._sensor(cameras, fovy, eye, mat, centred), roof)

    def _seen(self, shot: _TracedShot, samples: int) -> np.ndarray:
        """Albedo, normal and distance (h, w, 7) f32 of the surfaces in a picture."""
        found = self._mi.render(
            shot.scene,
            sensor=shot.sensor,
            integrator=self._surfaces,
            spp=samples,
            seed=0,
        )
        return np.array(found, np.float32)

    def _home(self, home: int) -> TracedHome:
        if home not in self._homes:
            self._homes[home] = TracedHome(self._mi, self.scene, home, self._light)
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

    def _developed(self, shot: _TracedShot) -> np.ndarray:
        """A picture (h, w, 3) uint8 sRGB."""
        samples = self.shading.samples
        found = self._mi.render(shot.scene, sensor=shot.sensor, spp=samples, seed=0)
        light = np.array(found, np.float32)
        if self.shading.denoise:
            seen = self._seen(shot, min(max(samples // 4, 1), MOST_SURFACES))
            albedo = np.ascontiguousarray(seen[..., _ALBEDO].clip(0.0, 1.0))
            light = denoise(light, albedo, np.ascontiguousarray(seen[..., _NORMAL]))
        exposure = self._light.exposure if shot.roof else self._light.open
        return srgb_bytes(compressed(exposure * np.asarray(light)))


def _fields_of_view(cameras: Cameras) -> np.ndarray:
    """Vertical fields of view (W, C) [rad]."""
    return np.broadcast_to(np.asarray(cameras.fovy, float), np.shape(cameras.pos)[:2])
