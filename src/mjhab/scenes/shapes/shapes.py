"""Constructors of geoms and procedural meshes, shared by furniture and objects. Poses are in the template's frame."""

from __future__ import annotations

import math

import numpy as np

from mjhab.core.arithmetic.elementary import tan
from mjhab.scenes.shapes.meshes import Mesh
from mjhab.scenes.spec import IDENTITY, Geom, Quat, Vec3


def box(
    center: Vec3,
    size: Vec3,
    material: str,
    *,
    quat: Quat = IDENTITY,
    collide: bool = True,
    visual: bool = True,
) -> Geom:
    """Make a box from its centre and full edge lengths [m]."""
    half = (size[0] / 2, size[1] / 2, size[2] / 2)
    return Geom("box", half, center, quat, material, collide=collide, visual=visual)


def span(
    x: tuple[float, float],
    y: tuple[float, float],
    z: tuple[float, float],
    material: str,
    *,
    collide: bool = True,
    visual: bool = True,
) -> Geom:
    """Make a box from its extents along the three axes [m]."""
    center = ((x[0] + x[1]) / 2, (y[0] + y[1]) / 2, (z[0] + z[1]) / 2)
    half = ((x[1] - x[0]) / 2, (y[1] - y[0]) / 2, (z[1] - z[0]) / 2)
    return Geom("box", half, center, IDENTITY, material, collide=collide, visual=visual)


def rod(
    center: Vec3,
    size: tuple[float, float],
    material: str,
    *,
    axis: str = "z",
    collide: bool = True,
    visual: bool = True,
) -> Geom:
    """Make a cylinder from its centre and its size, radius and full length [m], along a coordinate axis."""
    radius, length = size
    s = math.sqrt(0.5)
    quat = {"z": IDENTITY, "x": (s, 0.0, s, 0.0), "y": (s, s, 0.0, 0.0)}[axis]
    return Geom(
        "cylinder",
        (radius, length / 2, 0.0),
        center,
        quat,
        material,
        collide=collide,
        visual=visual,
    )


def ball(
    center: Vec3,
    radius: float,
    material: str,
    *,
    collide: bool = True,
    visual: bool = True,
) -> Geom:
    """Make a sphere from its centre and radius [m]."""
    return Geom(
        "sphere",
        (radius, 0.0, 0.0),
        center,
        IDENTITY,
        material,
        collide=collide,
        visual=visual,
    )


def look(
    mesh: str, material: str, pos: Vec3 = (0.0, 0.0, 0.0), quat: Quat = IDENTITY
) -> Geom:
    """Make a visual-only mesh geom from the name of a mesh."""
    return Geom("mesh", (1.0, 1.0, 1.0), pos, quat, material, mesh, collide=False)


def about_z(yaw: float) -> Quat:
    """Compute the quaternion wxyz of a rotation about +z [rad]."""
    return (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))


def lathe(profile: list[tuple[float, float]], segments: int = 24) -> Mesh:
    """Make a surface of revolution about the z axis.

    Args:
        profile: (radius, z) points [m], from the bottom up along the outside, so that faces point outwards.
        segments: number of segments around the axis.
    """
    angles = np.linspace(0.0, 2 * math.pi, segments, endpoint=False)
    rings = [
        np.stack([r * np.cos(angles), r * np.sin(angles), np.full(segments, z)], 1)
        for r, z in profile
    ]
    faces = []
    for i in range(len(profile) - 1):
        for j in range(segments):
            a = i * segments + j
            b = i * segments + (j + 1) % segments
            c = a + segments
            d = b + segments
            # On the axis a ring is one point, and a triangle there would have no area.
            if profile[i][0] > 1e-9:
                faces.append((a, b, d))
            if profile[i + 1][0] > 1e-9:
                faces.append((a, d, c))
    return Mesh(np.concatenate(rings).astype(np.float32), np.array(faces, np.int32))


def rounded_box(size: Vec3, radius: float, steps: int = 2) -> Mesh:
    """Make a box of full edge lengths ``size`` [m] with edges of radius ``radius`` [m] in ``steps`` segments."""
    half = np.array(size) / 2
    # With a larger radius the edges would pass each other.
    radius = min(radius, float(half.min()))
    vertices = []
    faces = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            v, f = _rounded_side(half, radius, steps, axis, sign)
            faces.append(f + sum(len(p) for p in vertices))
            vertices.append(v)
    return Mesh(
        np.concatenate(vertices).astype(np.float32),
        np.concatenate(faces).astype(np.int32),
    )


def _rounded_side(
    half: np.ndarray, radius: float, steps: int, axis: int, sign: float
) -> tuple[np.ndarray, np.ndarray]:
    u = (axis + 1) % 3
    v = (axis + 2) % 3
    core = half - radius

    def stops(k: int) -> np.ndarray:
        """Grid positions along an axis: the flat part as one cell, the rounded edges in steps of equal angle."""
        rim = core[k] + radius * tan(np.linspace(0.0, math.pi / 4, steps + 1))
        return np.concatenate([-rim[::-1], rim])

    grid_u, grid_v = np.meshgrid(stops(u), stops(v), indexing="ij")
    p = np.zeros((grid_u.size, 3))
    p[:, axis] = sign * half[axis]
    p[:, u] = grid_u.ravel()
    p[:, v] = grid_v.ravel()
    inner = np.clip(p, -core, core)
    away = p - inner
    p = inner + radius * away / np.maximum(
        # On the flat part there is no direction to the edge.
        np.linalg.norm(away, axis=1, keepdims=True),
        1e-12,
    )
    n, m = grid_u.shape
    a = (np.arange(n - 1)[:, None] * m + np.arange(m - 1)).ravel()
    quads = np.stack([a, a + m, a + m + 1, a + 1], 1)
    if sign < 0:
        quads = quads[:, ::-1]
    return p, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def foliage(seed: int, leaves: int, reach: float, height: float, leaf: float) -> Mesh:
    """Make the leaves of a plant, arched and growing from the origin.

    Args:
        seed: seed of the random arrangement.
        leaves: number of leaves.
        reach, height: largest radius and height [m].
        leaf: width of a leaf [m].
    """
    rng = np.random.default_rng(seed)
    vertices = []
    faces = []
    for i in range(leaves):
        # The golden angle: leaves never stand above each other.
        turn = 2.399963 * i + rng.uniform(-0.2, 0.2)
        out = reach * rng.uniform(0.45, 1.0)
        top = height * rng.uniform(0.55, 1.0) * (1.15 - 0.5 * out / reach)
        blade = _blade(out, top, leaf * rng.uniform(0.7, 1.1))
        c = math.cos(turn)
        s = math.sin(turn)
        blade = blade @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        base = 8 * i
        vertices.append(blade)
        for k in range(3):
            a = base + 2 * k
            up = [(a, a + 1, a + 3), (a, a + 3, a + 2)]
            # Both sides of a leaf are seen.
            faces += up + [f[::-1] for f in up]
    return Mesh(np.concatenate(vertices).astype(np.float32), np.array(faces, np.int32))


def _blade(out: float, top: float, width: float) -> np.ndarray:
    t = np.array([0.0, 0.35, 0.7, 1.0])
    x = out * t**1.3
    z = top * np.sin(t * 1.9) / math.sin(1.9 * 0.83)
    w = width / 2 * np.array([0.25, 1.0, 0.9, 0.05])
    return np.stack([np.repeat(x, 2), np.stack([-w, w], 1).ravel(), np.repeat(z, 2)], 1)
