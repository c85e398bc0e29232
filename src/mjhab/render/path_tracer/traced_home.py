"""One home as scenes of Mitsuba: built once, its bodies put at the poses of every picture."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mjhab.render.models import Part, home_models
from mjhab.render.path_tracer.lights import TIMES, daylight, lamp, sky, sun
from mjhab.render.path_tracer.materials import FEW_SAMPLES, surface
from mjhab.render.path_tracer.windows import (
    WALL,
    Rect,
    one_home,
    open_windows,
    skylights,
)
from mjhab.render.raster.arrays import PARKED_BELOW
from mjhab.render.render_scene import RenderScene
from mjhab.scenes.formats.gltf import MAX_TEXTURE
from mjhab.scenes.shading import CUDA, Shading

MAX_DEPTH = 3
"""Longest path: two reflections; the exposure of `lights` makes up for the light of longer ones. A third one takes
0.03 s of a core more for 128 x 128 pixels of 4 paths."""
ROULETTE_FROM = 1
"""Reflection from which a path ends by chance, the likelier the darker the surface. It takes a third of the time, and
is no change of the light: 0.24 instead of 0.34 s of a core for 128 x 128 pixels of 4 paths."""
SUNBEAMS = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}
"""What sees the sun: no reflections, since `Daylight.exposure` makes up for them, and no noise."""
FEW_FACES = 250
"""Most faces of a mesh in pictures of few paths per pixel. Mitsuba builds its trees of all faces anew when a body
moves: 14 instead of 44 ms of a core for the two scenes of a home."""
CEILING = (0.88, 0.88, 0.86)
Groups = list[tuple[tuple[int, ...], Any]]
"""Shape groups of Mitsuba, each with the bodies that look like it."""


class PlacedHome(NamedTuple):
    """Scenes of Mitsuba whose light adds up.

    Attributes:
        room: with the sky, panes of daylight and lamps: light that goes from surface to surface.
        sun: with the sun alone, which panes of daylight would shut out; None if it does not shine.
    """

    room: Any
    sun: Any | None


class TracedHome:
    """The scenes of one home, with a ceiling for cameras below it, and without for those above.

    Args:
        mi: Mitsuba with its variant.
        scene: of the layout.
        home: index of the home in it.
        shading: samples and the time of day.

    Attributes:
        ceiling: height of the ceiling [m]; -inf without walls, under the open sky.
    """

    def __init__(self, mi: Any, scene: RenderScene, home: int, shading: Shading) -> None:
        self._mi = mi
        self._samples = shading.samples
        self._light = TIMES[shading.light]
        alone = one_home(scene, home)
        span, self.ceiling = _walls(alone)
        alone, self._openings = open_windows(alone)
        faces = FEW_FACES if shading.samples <= FEW_SAMPLES else None
        drawn = home_models(alone, 0, faces, max_side=MAX_TEXTURE)
        self._ceiling = [span]
        # Without windows no daylight would come in at all.
        if not self._openings:
            self._openings, self._ceiling = skylights(drawn.lamp_pos, span, self.ceiling)
        self._drawn = drawn
        self._groups = self._shapes()
        self._lamps = list(zip(drawn.lamp_pos, drawn.lamp_color, strict=True))
        self._scenes: dict[bool, list[_PlacedScene]] = {}

    def placed(self, roof: bool, pos: np.ndarray, mat: np.ndarray) -> PlacedHome:
        """The home with its bodies at the poses (B, 3) [m] and (B, 3, 3).

        Args:
            roof: with the ceiling.
            pos, mat: of the bodies of the world.
        """
        if roof not in self._scenes:
            # The world itself does not move.
            bodies = [b for seen, _ in self._groups for b in seen if b != 0]
            made = self._inside() if roof else [self._open()]
            self._scenes[roof] = [
                _PlacedScene(self._mi, self._mi.load_dict(scene), bodies)
                for scene in made
            ]
        room, *sun = (scene.at(pos, mat) for scene in self._scenes[roof])
        return PlacedHome(room, sun[0] if sun else None)

    def _shapes(self) -> Groups:
        """Shape groups, each with the bodies that look like it; (0,) is the world."""
        mi = self._mi
        drawn = self._drawn
        surfaces = [
            mi.load_dict(surface(mi, look, self._samples)) for look in drawn.looks
        ]
        groups = []
        for model in (drawn.home, *drawn.movable):
            group: dict[str, Any] = {"type": "shapegroup"}
            for k, part in enumerate(model.parts):
                group[f"part{k}"] = _mesh(mi, part, surfaces[part.look])
            groups.append((model.bodies, mi.load_dict(group)))
        return groups

    def _open(self) -> dict[str, Any]:
        """Without ceiling, under the sky."""
        made = self._furnished(self._groups) | self._lit_by_lamps()
        made["sky"] = sky(self._mi, self._light)
        if self._light.sunny:
            made["sun"] = sun(self._light)
        return made

    def _inside(self) -> list[dict[str, Any]]:
        """Below the ceiling: the room, and by day a second scene with the sun."""
        ceiling = {
            f"ceiling{k}": _ceiling(self._mi, rect, self.ceiling)
            for k, rect in enumerate(self._ceiling)
        }
        room = self._furnished(self._groups) | ceiling | self._lit_by_lamps()
        if not self._light.sunny or not self._openings:
            return [room | {"sky": sky(self._mi, self._light)}]
        for k, opening in enumerate(self._openings):
            room[f"daylight{k}"] = daylight(self._mi, self._light, opening)
        # On a GPU the process ends where two scenes share a group.
        own = self._shapes() if self._mi.variant() == CUDA else self._groups
        lit = {"integrator": SUNBEAMS, "sun": sun(self._light)}
        return [room, self._furnished(own) | ceiling | lit]

    def _furnished(self, groups: Groups) -> dict[str, Any]:
        made: dict[str, Any] = {
            "type": "scene",
            "integrator": {
                "type": "path",
                "max_depth": MAX_DEPTH,
                "rr_depth": ROULETTE_FROM,
            },
        }
        for bodies, group in groups:
            made[f"group{bodies[0]}"] = group
            for body in bodies:
                made[f"body{body}"] = {"type": "instance", "group": group}
        return made

    def _lit_by_lamps(self) -> dict[str, Any]:
        return {
            f"lamp{k}": lamp(self._light, pos, color)
            for k, (pos, color) in enumerate(self._lamps)
        }


def _ceiling(mi: Any, rect: Rect, height: float) -> dict[str, Any]:
    x0, y0, x1, y1 = rect
    place = mi.ScalarTransform4f().translate([(x0 + x1) / 2, (y0 + y1) / 2, height])
    return {
        "type": "rectangle",
        "to_world": place.scale([(x1 - x0) / 2, (y1 - y0) / 2, 1.0]),
        "surface": {
            "type": "twosided",
            "inner": {
                "type": "diffuse",
                "reflectance": {"type": "rgb", "value": list(CEILING)},
            },
        },
    }


class _PlacedScene:
    """A scene of Mitsuba and the parameters that move its bodies."""

    def __init__(self, mi: Any, scene: Any, bodies: list[int]):
        self._mi = mi
        self._scene = scene
        self._bodies = bodies
        self._params = mi.traverse(scene)
        keep = [f"body{body}.to_world" for body in self._bodies]
        self._params.keep(keep)
        # NaN differs from every pose, so that the first picture places all bodies.
        self._last = np.full((len(self._bodies), 4, 4), np.nan)

    def at(self, pos: np.ndarray, mat: np.ndarray) -> Any:
        pose = np.tile(np.eye(4), (len(self._bodies), 1, 1))
        pose[:, :3, :3] = mat[self._bodies]
        pose[:, :3, 3] = pos[self._bodies]
        moved = np.flatnonzero((pose != self._last).any((1, 2)))
        for k in moved.tolist():
            to_world = self._mi.ScalarTransform4f(pose[k])
            self._params[f"body{self._bodies[k]}.to_world"] = self._mi.Transform4f(
                to_world
            )
        if len(moved):
            self._params.update()
            self._last = pose
        return self._scene


def _walls(scene: RenderScene) -> tuple[Rect, float]:
    """Extent x0, y0, x1, y1 of the walls of a scene of one home [m], and their height; zeros and -inf for none."""
    there = (scene.home_scale[0] != 0.0).all(axis=1)
    there &= (scene.home_pos[0, :, 2] > PARKED_BELOW) & (scene.instance_body == 0)
    names = np.array(scene.seg_names)[scene.instance_seg]
    rows = np.flatnonzero(there & (names == WALL))
    if not len(rows):
        return (0.0, 0.0, 0.0, 0.0), -np.inf
    half = np.einsum(
        "nij,nj->ni", np.abs(scene.home_mat[0, rows]), np.abs(scene.home_scale[0, rows])
    )
    low = (scene.home_pos[0, rows] - half).min(axis=0)
    high = (scene.home_pos[0, rows] + half).max(axis=0)
    return (low[0], low[1], high[0], high[1]), float(high[2])


def _mesh(mi: Any, part: Part, look: Any) -> Any:
    """A mesh of Mitsuba."""
    properties = mi.Properties()
    properties["surface"] = look
    mesh = mi.Mesh(
        "part",
        vertex_count=len(part.vertices),
        face_count=len(part.faces),
        has_vertex_normals=True,
        has_vertex_texcoords=True,
        props=properties,
    )
    params = mi.traverse(mesh)
    params["vertex_positions"] = np.ascontiguousarray(part.vertices, np.float32).ravel()
    params["vertex_normals"] = np.ascontiguousarray(part.normals, np.float32).ravel()
    params["vertex_texcoords"] = np.ascontiguousarray(part.uv, np.float32).ravel()
    params["faces"] = np.ascontiguousarray(part.faces, np.uint32).ravel()
    params.update()
    return mesh
