"""Reader of YCB objects: scans of the YCB Object and Model Set as movable objects.

A file ``<object>/textured.glb`` per object has a scan (metres, +z up, arbitrary origin). It becomes an object with its
origin at the centre of the scan's bounding box. Box-shaped objects are rotated about z so that their faces are aligned
with the axes; ``ObjectType.scan_yaw`` has the angle, for files with poses in the axes of the scan.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.core.errors import fault
from mjhab.scenes.builtin.objects import BOWL_WALL_M, MASSES
from mjhab.scenes.formats.gltf import Primitive, read_glb
from mjhab.scenes.object_glb import check_extent
from mjhab.scenes.shapes.hulls import hull_mesh
from mjhab.scenes.shapes.meshes import Mesh
from mjhab.scenes.shapes.painting import textured_mesh
from mjhab.scenes.shapes.shapes import about_z, look
from mjhab.scenes.spec import Geom, ObjectType, Vec3

SCAN = "textured.glb"
PRIMITIVE_TOLERANCE_M = 0.003
"""A scan collides as a box or cylinder if `PRIMITIVE_SHARE` of the area of its convex hull lies within this [m]."""
PRIMITIVE_SHARE = 0.90
"""Fraction of the hull's area; below 1, because boxes and tins have rounded edges."""
MAX_HOLLOW_SHARE = 0.6
"""A scan whose volume is less than this fraction of its convex hull's is hollow and collides as a bowl."""
HULL_DIRECTIONS = 160
"""Largest number of vertices of a collision hull."""
RIM_PIECES = 16
BASE_PIECES = 8
_MAX_SAMPLE_EDGE_M = 0.006


@dataclass(frozen=True, eq=False)
class Scan:
    """A scan with the origin at the centre of its bounding box.

    ``vertices`` (V, 3) [m], ``faces`` (F, 3); ``uv`` (V, 2) and ``texture`` (h, w, 3) uint8 as in ``gltf.Primitive``,
    or None for plain white.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None = None
    texture: np.ndarray | None = None


def read_ycb(folder: Path) -> tuple[dict[str, ObjectType], dict[str, object]]:
    """Read the ten objects of the benchmark.

    Args:
        folder: holds one folder per object, named as in ``MASSES``.

    Returns:
        Object types by name, and the meshes (``scenes.shapes.meshes.Mesh``) of their geoms by name.

    Raises:
        UsageError: a scan is missing or broken; the message names the file.
    """
    for name in MASSES:
        if not (folder / name / SCAN).is_file():
            raise fault(
                folder,
                f"YCB folder without {name}/{SCAN}; it must hold the ten objects "
                f"{', '.join(MASSES)}. `mjhab assets fetch ycb` gets them.",
            )
    types: dict[str, ObjectType] = {}
    meshes: dict[str, object] = {}
    for name in MASSES:
        path = folder / name / SCAN
        try:
            types[name], added = object_from_scan(name, read_scan(path))
        except QhullError as error:
            raise fault(path, "the scan is flat; download the file again.") from error
        meshes.update(added)
    return types, meshes


def read_scan(path: Path) -> Scan:
    """Read a textured mesh.

    Raises:
        UsageError: the file is broken, has no texture, or its size is not that of an object; the message names it.
    """
    part, *others = read_glb(path)
    # The scans of the benchmark are one mesh each; anything else is another file.
    if others or part.texture is None or part.uv is None:
        raise fault(
            path, "not one mesh with a base colour texture; download the file again."
        )
    extent = np.ptp(part.vertices, axis=0)
    check_extent(
        path, extent, "This is no scan of a YCB object; download the file again."
    )
    center = (part.vertices.min(axis=0) + part.vertices.max(axis=0)) / 2
    return Scan(
        part.vertices - center, part.faces.astype(np.int64), part.uv, part.texture
    )


def object_from_scan(name: str, scan: Scan) -> tuple[ObjectType, dict[str, Mesh]]:
    """Make an object type from a scan.

    It collides as a box, a cylinder, a bowl of convex pieces, or one convex hull.

    Returns:
        The type, and the meshes of its geoms by name.
    """
    surface = HullSurface.of(scan.vertices)
    yaw, half = box_fit(scan.vertices, surface)
    meshes: dict[str, Mesh] = {}
    if primitive_share(surface.turned(-yaw), "box", half) >= PRIMITIVE_SHARE:
        collision = [Geom("box", half, visual=False)]
    else:
        # Only boxes are rotated to align with the axes.
        yaw = 0.0
        half = can_fit(scan.vertices, surface)
        if primitive_share(surface, "cylinder", half) >= PRIMITIVE_SHARE:
            collision = [Geom("cylinder", (half[0], half[2], 0.0), visual=False)]
        else:
            x, y, z = (np.ptp(scan.vertices, axis=0) / 2).tolist()
            half = (x, y, z)
            collision, meshes = (
                _bowl(name, scan) if _fill(scan) < MAX_HOLLOW_SHARE else _lump(name, scan)
            )
    meshes[f"{name}_look"] = render_mesh(scan, -yaw)
    visuals = (look(f"{name}_look", "plain_white"),)
    return ObjectType(
        # From 0.0: the negative of 0 would be -0.0, which hashes differently.
        name,
        MASSES[name],
        half,
        tuple(collision),
        visuals,
        scan_yaw=0.0 - yaw,
    ), meshes


# -- primitives --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class HullSurface:
    """Samples of the surface of a convex hull: ``points`` (P, 3) [m], outward unit ``normals`` (P, 3), ``areas`` (P,)
    [m^2]."""

    points: np.ndarray
    normals: np.ndarray
    areas: np.ndarray

    @staticmethod
    def of(vertices: np.ndarray) -> HullSurface:
        """Sample the hull of ``vertices`` (V, 3) [m]: one point per triangle, with edges up to `_MAX_SAMPLE_EDGE_M`."""
        hull = ConvexHull(vertices)
        triangles = vertices[hull.simplices]
        normals = hull.equations[:, :3]
        done: list[tuple[np.ndarray, np.ndarray]] = []
        while len(triangles):
            edge = np.linalg.norm(triangles - np.roll(triangles, -1, axis=1), axis=2)
            large = edge.max(axis=1) > _MAX_SAMPLE_EDGE_M
            done.append((triangles[~large], normals[~large]))
            triangles = _halve(triangles[large], edge[large])
            normals = np.repeat(normals[large], 2, axis=0)
        corners = np.concatenate([part[0] for part in done])
        a = corners[:, 0]
        b = corners[:, 1]
        c = corners[:, 2]
        areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        return HullSurface(
            corners.mean(axis=1), np.concatenate([part[1] for part in done]), areas
        )

    def turned(self, yaw: float) -> HullSurface:
        """Return the samples rotated about z by ``yaw`` [rad]."""
        return HullSurface(_turn(self.points, yaw), _turn(self.normals, yaw), self.areas)


def box_fit(vertices: np.ndarray, surface: HullSurface) -> tuple[float, Vec3]:
    """Fit an upright box, centred at the origin, to a scan.

    The heading is that of the smallest rectangle around the horizontal projection. Each side is at the median of the
    hull's area that faces it, so that bulges count little; top and bottom are at the extremes, on which objects stand.

    Args:
        vertices: (V, 3) [m].
        surface: samples of their convex hull.

    Returns:
        Heading [rad] in (-pi/4, pi/4] and half-extents (3,) [m].
    """
    plan = vertices[ConvexHull(vertices[:, :2]).vertices][:, :2]
    # A rectangle repeats after a quarter turn; without the first angle, which is the last one turned.
    angles = np.linspace(-np.pi / 4, np.pi / 4, 901)[1:]
    areas = [np.ptp(_turn(plan, -a), axis=0).prod() for a in angles]
    yaw = float(angles[int(np.argmin(areas))])
    turned = surface.turned(-yaw)
    return yaw, (
        _face_distance(turned, 0),
        _face_distance(turned, 1),
        float(np.ptp(vertices[:, 2]) / 2),
    )


def _face_distance(surface: HullSurface, axis: int) -> float:
    """Mean distance [m] from the origin of the two sides that face along an axis, each its median by area."""
    sides = []
    for sign in (-1.0, 1.0):
        # Within 20 degrees: rounded edges do not count as sides.
        facing = sign * surface.normals[:, axis] > 0.94
        height = sign * surface.points[:, axis]
        if not facing.any():
            return float(np.abs(surface.points[:, axis]).max())
        order = np.argsort(height[facing])
        total = np.cumsum(surface.areas[facing][order])
        sides.append(float(height[facing][order][np.searchsorted(total, total[-1] / 2)]))
    return ordered_sum(sides) / 2


def can_fit(vertices: np.ndarray, surface: HullSurface) -> Vec3:
    """Fit an upright cylinder, centred at the origin, to a scan; returns (radius, radius, half-height) [m]."""
    # Rims and lids would make the radius smaller.
    side = np.abs(surface.normals[:, 2]) < 0.3
    radius = np.hypot(surface.points[side, 0], surface.points[side, 1])
    mean = (
        float(np.average(radius, weights=surface.areas[side]))
        if side.any()
        else float(np.ptp(vertices[:, 0]) / 2)
    )
    return (mean, mean, float(np.ptp(vertices[:, 2]) / 2))


def primitive_share(surface: HullSurface, shape: str, half: Vec3) -> float:
    """Compute the fraction of a hull's area within `PRIMITIVE_TOLERANCE_M` of an upright primitive at the origin.

    Args:
        surface: samples of the hull.
        shape: "box" or "cylinder".
        half: half-extents (3,) of the primitive [m].
    """
    points = surface.points
    if shape == "box":
        beyond = np.abs(points) - np.array(half)
    else:
        radial = np.hypot(points[:, 0], points[:, 1]) - half[0]
        beyond = np.stack([radial, np.abs(points[:, 2]) - half[2]], axis=1)
    gap = np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(
        beyond.max(axis=1), 0.0
    )
    return float(
        surface.areas[np.abs(gap) <= PRIMITIVE_TOLERANCE_M].sum() / surface.areas.sum()
    )


def _halve(triangles: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """Bisect triangles (T, 3, 3) at the middle of their longest edge: (2 T, 3, 3); ``edge`` (T, 3): edge lengths."""
    first = edge.argmax(axis=1)
    a, b, c = (
        np.take_along_axis(triangles, ((first + k) % 3)[:, None, None], axis=1)[:, 0]
        for k in range(3)
    )
    middle = (a + b) / 2
    return np.stack(
        [np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)], axis=1
    ).reshape(-1, 3, 3)


# -- other shapes ------------------------------------------------------------------------------------------------------


def _fill(scan: Scan) -> float:
    """Volume that a scan's surface encloses, as a fraction of its convex hull's."""
    a, b, c = (scan.vertices[scan.faces[:, k]] for k in range(3))
    inside = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    return float(abs(inside) / ConvexHull(scan.vertices).volume)


def hull_of(points: np.ndarray) -> Mesh:
    """Compute a convex hull of points (P, 3) with at most `HULL_DIRECTIONS` vertices.

    They are the extreme points in evenly spread directions, among them the axes, so that the bounding box is kept.
    """
    corners = points[ConvexHull(points).vertices]
    # With the six axes, so that the hull is as high and as wide as the scan.
    directions = np.concatenate([_sphere(HULL_DIRECTIONS - 6), np.eye(3), -np.eye(3)])
    chosen = corners[np.unique((directions @ corners.T).argmax(axis=1))]
    return hull_mesh(chosen)


def _sphere(count: int) -> np.ndarray:
    """(count, 3) unit vectors spread evenly (Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = np.pi * (1 + math.sqrt(5)) * k
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)


def _lump(name: str, scan: Scan) -> tuple[list[Geom], dict[str, Mesh]]:
    """Collision geom and mesh of a scan as one convex hull."""
    mesh = f"{name}_hull"
    return [Geom("mesh", (1.0, 1.0, 1.0), mesh=mesh, visual=False)], {
        mesh: hull_of(scan.vertices)
    }


def _bowl(name: str, scan: Scan) -> tuple[list[Geom], dict[str, Mesh]]:
    """Collision geoms and meshes of a bowl: a disk as floor, and two rings of convex wedges along the outer profile."""
    foot, knee, rim = bowl_profile(scan.vertices)
    floor = Geom(
        "cylinder",
        (foot[0], BOWL_WALL_M / 2, 0.0),
        (0.0, 0.0, foot[1] + BOWL_WALL_M / 2),
        visual=False,
    )
    geoms = [floor]
    meshes = {}
    for part, low, high, count in (
        ("rim", knee, rim, RIM_PIECES),
        ("base", foot, knee, BASE_PIECES),
    ):
        mesh = f"{name}_{part}"
        meshes[mesh] = hull_of(_wedge(low, high, count))
        for i in range(count):
            turn = about_z(2 * math.pi * i / count)
            geoms.append(
                Geom("mesh", (1.0, 1.0, 1.0), quat=turn, mesh=mesh, visual=False)
            )
    return geoms, meshes


def bowl_profile(vertices: np.ndarray) -> tuple[tuple[float, float], ...]:
    """Compute the outer profile of a bowl: (radius, z) [m] at its foot, its knee and its rim.

    The knee is the point of the outline farthest from the chord between foot and rim. The radius of the rim minimises
    the largest distance between the outline and a straight wall from the knee.

    Args:
        vertices: (V, 3) [m], centred about the z axis.
    """
    low = float(vertices[:, 2].min())
    high = float(vertices[:, 2].max())
    levels = np.linspace(low, high, 23)
    middles = (levels[:-1] + levels[1:]) / 2
    index = np.clip(np.searchsorted(levels, vertices[:, 2]) - 1, 0, len(middles) - 1)
    radius = np.hypot(vertices[:, 0], vertices[:, 1])
    outline = np.array(
        # Not the largest radius: scans have stray points.
        [np.percentile(radius[index == k], 95) for k in range(len(middles))]
    )
    chord = outline[0] + (outline[-1] - outline[0]) * (middles - middles[0]) / (
        middles[-1] - middles[0]
    )
    knee = int(np.argmax(outline - chord))
    wall = slice(knee, None)
    shares = (middles[wall] - middles[knee]) / (high - middles[knee])
    rims = np.linspace(outline[knee], outline[-1], 81)
    off = np.abs(
        outline[knee] + shares[:, None] * (rims - outline[knee]) - outline[wall][:, None]
    ).max(axis=0)
    return (
        (float(outline[0]), low),
        (float(outline[knee]), float(middles[knee])),
        (float(rims[int(np.argmin(off))]), high),
    )


def _wedge(low: tuple[float, float], high: tuple[float, float], count: int) -> np.ndarray:
    """Corners (8, 3) [m] of one of ``count`` wedges of a conical wall of thickness `BOWL_WALL_M`, centred about +x.

    ``low``, ``high``: outer (radius, z) [m] of the cone; the flat outside of the wedge approximates it from both sides.
    """
    a = math.pi / count
    slope = math.atan2(high[0] - low[0], high[1] - low[1])
    inward = BOWL_WALL_M / math.cos(slope)
    # Halfway between the inscribed and the circumscribed polygon.
    grow = 2 / (1 + math.cos(a))
    corners = []
    for radius, z in (low, high):
        for r in (grow * radius, max(grow * radius - inward, 0.0)):
            corners += [(r * math.cos(t), r * math.sin(t), z) for t in (-a, a)]
    return np.array(corners)


# -- looks -------------------------------------------------------------------------------------------------------------


def render_mesh(scan: Scan, yaw: float) -> Mesh:
    """Make the render mesh of a scan, rotated about z by ``yaw`` [rad]: all triangles, with the texture."""
    part = Primitive(
        "scan", _turn(scan.vertices, yaw), scan.faces, scan.uv, scan.texture, np.ones(3)
    )
    return textured_mesh([part])


def _turn(points: np.ndarray, yaw: float) -> np.ndarray:
    """Points (P, 2 or 3) rotated about z by ``yaw`` [rad]."""
    c = math.cos(yaw)
    s = math.sin(yaw)
    turned = points.copy()
    turned[:, 0] = c * points[:, 0] - s * points[:, 1]
    turned[:, 1] = s * points[:, 0] + c * points[:, 1]
    return turned
