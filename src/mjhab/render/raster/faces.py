"""Kernels that compute once per image how its camera sees each face: normal, material, place in the texture.

Along a ray with the slopes (u right, v up), normal and texture coordinates of a face at a depth [m] are
``a + depth * (b * u + c * v + d)``. An image has some hundred faces but some thousand runs, so that this is worth
keeping from run to run.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjhab.render.jit import color_inline
from mjhab.render.raster.arrays import FACE_BITS
from mjhab.render.raster.lighting import MOST_NODES
from mjhab.render.raster.surfaces import fill_frame, normal_at, place_point

MOST_FACES = 4 * MOST_NODES
"""Rows of `FaceViews`. One stripe of an image needs up to MOST_NODES."""
KEY_BITS = 11
"""log2 of the length of `FaceViews.keys`."""
A, B, C, D, S, T, COLOR, OTHER, FLAT, GLOSS, DENSITY, KIND, TEXTURE = (
    np.uint64(column) for column in (0, 3, 6, 9, 12, 16, 20, 23, 26, 27, 28, 29, 30)
)
"""Columns of `FaceViews`: three each of a, b, c, d of the normal, in the world and of any length; a, b, c, d of
the texture coordinate s and of t; linear rgb of the colour, and what the pattern's other colour differs by; 1 on flat
faces, else 0; gloss; texels of level 0 that a pixel of a face covers that faces the camera at a depth of 1 m; PLAIN,
PATTERN or IMAGE; number of the texture."""
NUMBERS = 32
"""Numbers of a row: two lines of the cache, because a new image finds few of them there."""
PLAIN, PATTERN, IMAGE = range(3)
_HASH = np.uint32(0x9E3779B1)
"""Knuth's multiplier: the upper bits of the product spread over the table."""


class FaceViews(NamedTuple):
    """How a camera sees the faces of an image, a row for each.

    Attributes:
        numbers: (MOST_FACES * NUMBERS,) f32, row by row, see `A`. Kernels know a row by the place of its first number.
        keys, rows: (2**KEY_BITS,) i32, hash table from the id of a pixel (see `arrays.FACE_BITS`) to its row. Of two
            faces with the same hash the later stays in the table, and the other gets another row when it is seen again.
        count: (1,) i64, rows in use.
    """

    numbers: np.ndarray
    keys: np.ndarray
    rows: np.ndarray
    count: np.ndarray


def make_face_views() -> FaceViews:
    """Allocate the memory of one thread."""
    return FaceViews(
        np.zeros(MOST_FACES * NUMBERS, np.float32),
        np.full(1 << KEY_BITS, -1, np.int32),
        np.zeros(1 << KEY_BITS, np.int32),
        np.zeros(1, np.int64),
    )


@color_inline
def forget_faces(views):
    """Begin a table of no faces."""
    views.count[0] = 0
    for k in range(np.uint64(len(views.keys))):
        views.keys[k] = np.int32(-1)


@color_inline
def _view_normal(numbers, n, surface, f, i, face):
    """Fill columns A to D of row ``n`` for a face of instance ``i``, whose frame is ``f[i]``."""
    e = surface.face_normal
    for r in range(3):
        at = np.uint64(r)
        m = np.uint64(15 + 3 * r)
        turn = (f[i, m], f[i, m + np.uint64(1)], f[i, m + np.uint64(2)])
        a = turn[0] * e[face, 0, 3] + turn[1] * e[face, 1, 3] + turn[2] * e[face, 2, 3]
        b = 0.0
        c = 0.0
        d = 0.0
        if surface.smooth[face]:
            for k in range(3):
                change = (
                    turn[0] * e[face, 0, k]
                    + turn[1] * e[face, 1, k]
                    + turn[2] * e[face, 2, k]
                ) * f[i, 12 + k]
                a += change * f[i, k]
                b += change * f[i, 3 + 3 * k]
                c += change * f[i, 4 + 3 * k]
                d -= change * f[i, 5 + 3 * k]
        numbers[n + A + at] = a
        numbers[n + B + at] = b
        numbers[n + C + at] = c
        numbers[n + D + at] = d


@color_inline
def _view_along(numbers, n, first, f, i, axis, scale):
    """Fill a, b, c, d of row ``n`` from column ``first`` for ``scale`` times a coordinate of the instance."""
    ray = np.uint64(3) + np.uint64(3) * axis
    numbers[n + first] = f[i, axis] * scale
    numbers[n + first + np.uint64(1)] = f[i, ray] * scale
    numbers[n + first + np.uint64(2)] = f[i, ray + np.uint64(1)] * scale
    numbers[n + first + np.uint64(3)] = -f[i, ray + np.uint64(2)] * scale


@color_inline
def _view_pattern(numbers, n, surface, f, i, face, m, u, v, depth):
    """Fill columns S and T of row ``n`` for a pattern, by the normal on the ray (u, v) at a depth [m].

    A pattern lies in the coordinate plane of the instance that is most parallel to the face; s runs along the longer
    side of the instance.
    """
    x, y, z = place_point(f, i, u, v, depth)
    x, y, z = normal_at(surface, f, i, face, x, y, z)
    x = abs(x)
    y = abs(y)
    z = abs(z)
    across = 0 if x >= y else 1
    across = 2 if z >= max(x, y) else across
    first = np.uint64(f[i, 24 + across])
    second = np.uint64(3 - across) - first
    _view_along(numbers, n, S, f, i, first, surface.periods[m, 0])
    _view_along(numbers, n, T, f, i, second, surface.periods[m, 1])
    # Every instance has another offset in the pattern.
    numbers[n + S] += 0.37 * i
    numbers[n + T] += 0.23 * i


@color_inline
def _view_image(numbers, n, surface, f, i, face):
    """Fill columns S and T of row ``n`` for the texture coordinates of a face of instance ``i``."""
    e = surface.face_uv
    for side in range(2):
        first = S if side == 0 else T
        a = e[face, side, 3]
        b = 0.0
        c = 0.0
        d = 0.0
        for k in range(3):
            change = e[face, side, k] * f[i, 12 + k]
            a += change * f[i, k]
            b += change * f[i, 3 + 3 * k]
            c += change * f[i, 4 + 3 * k]
            d -= change * f[i, 5 + 3 * k]
        numbers[n + first] = a
        numbers[n + first + np.uint64(1)] = b
        numbers[n + first + np.uint64(2)] = c
        numbers[n + first + np.uint64(3)] = d


@color_inline
def _view_material(numbers, n, surface, f, i, face, m, inv):
    """Fill the columns of row ``n`` that depend on the material ``m``; returns its kind."""
    c = surface.color
    other = surface.color2
    for k in range(3):
        at = np.uint64(k)
        numbers[n + COLOR + at] = c[m, k]
        numbers[n + OTHER + at] = other[m, k] - c[m, k]
    numbers[n + GLOSS] = surface.gloss[m]
    kind = PLAIN
    density = surface.density[m] * inv
    if surface.texture[m] >= 0:
        kind = PATTERN if surface.pattern[m] else IMAGE
        if kind == IMAGE:
            density *= surface.face_density[face] * f[i, 27]
    numbers[n + DENSITY] = density
    numbers[n + KIND] = kind
    numbers[n + TEXTURE] = surface.texture[m]
    return kind


@color_inline
def view_face(surface, poses, home, looks, lens, scratch, key, u, v, depth):
    """Row of `FaceViews` of the face of a pixel with the id ``key``; fills it unless it is there.

    ``u``, ``v``, ``depth``: a ray and a depth [m] at which the face is seen.
    """
    views = scratch.faces
    place = np.uint64(np.uint32(np.uint32(key) * _HASH) >> np.uint32(32 - KEY_BITS))
    if views.keys[place] == key:
        return np.uint64(views.rows[place])
    n = np.uint64(views.count[0] * NUMBERS)
    views.count[0] += 1
    i = np.uint64(key >> FACE_BITS)
    face = np.uint64(
        surface.mesh_start[np.uint64(poses.drawn[i])] + (key & ((1 << FACE_BITS) - 1))
    )
    m = surface.instance_material[home, i]
    if m < 0:
        m = surface.face_material[face]
    m = np.uint64(looks[np.uint64(m)])
    f = scratch.frames
    fill_frame(poses, surface.extent, scratch, lens, i)
    smooth = surface.smooth[face]
    views.numbers[n + FLAT] = 0.0 if smooth else 1.0
    _view_normal(views.numbers, n, surface, f, i, face)
    kind = _view_material(views.numbers, n, surface, f, i, face, m, 1.0 / lens.focal)
    if kind == PATTERN:
        _view_pattern(views.numbers, n, surface, f, i, face, m, u, v, depth)
    elif kind == IMAGE:
        _view_image(views.numbers, n, surface, f, i, face)
    # The axes of a pattern may change along a smooth face: every run has its own.
    if not (smooth and kind == PATTERN):
        views.keys[place] = key
        views.rows[place] = np.int32(n)
    return n
