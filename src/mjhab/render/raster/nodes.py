"""Kernels that find the runs of a stripe of an image, and place the nodes of their light.

A run is a part of a row that shows one face; nodes are its pixels at which light is computed. What reads at computed
places (of faces, of cells) stands in loops of its own: the other loops over nodes have neither branches nor such reads,
and only so the compiler computes eight nodes at a time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjhab.render.jit import color_inline
from mjhab.render.raster.faces import (
    FLAT,
    KIND,
    PLAIN,
    A,
    B,
    C,
    D,
    view_face,
)
from mjhab.render.raster.faces import GLOSS as FACE_GLOSS
from mjhab.render.raster.lighting import (
    DB,
    DG,
    DR,
    FACING,
    GLOSS,
    LIT,
    MOST_NODES,
    NODE_ROW,
    NX,
    NY,
    NZ,
    OPEN,
    SB,
    SG,
    SLANT,
    SR,
    VX,
    VY,
    VZ,
    X,
    Y,
    Z,
)
from mjhab.render.raster.occlusion import BORDER

SHORT_RUN = 3
"""Runs up to this many samples have constant light, that of their middle."""
PIXEL_ROW = MOST_NODES + 48
"""Length of a row of ``pixels``, a flat f32 array as `lighting.NODE_ROW` tells; loops that fill a run may write beyond
its end, where the next run follows. The rows are the depth DEPTH [m] and the linear colour LINE_R, LINE_G, LINE_B of
the pixels of a stripe, and of its textured pixels, without gaps between them, the place between texels ACROSS, DOWN
0..1 and the bytes of the texture TEXEL_R, TEXEL_G, TEXEL_B."""
PIXEL_ROWS = 9
DEPTH, LINE_R, LINE_G, LINE_B, ACROSS, DOWN, TEXEL_R, TEXEL_G, TEXEL_B = (
    np.uint64(row * PIXEL_ROW) for row in range(PIXEL_ROWS)
)
RUN_ROW = MOST_NODES + 16
RUN_ROWS = 5
START, ROW, FACE, NODE, SLOT = (np.uint64(row * RUN_ROW) for row in range(RUN_ROWS))
"""Rows of ``runs``, a flat i32 array: first pixel of the stripe; row of the stripe; face, see `faces.FaceViews`, -1 for
the background; first node; first place among the textured pixels."""
_SHARES = LIT, DR, DG, DB
_DEPTHS = SR, SG, SB, VX
"""Rows of nodes that hold the four nearest cells of ambient occlusion before they get what they are named for."""
_ZERO = np.float32(0.0)
_HALF = np.float32(0.5)
_ONE = np.float32(1.0)
_FARTHEST = np.float32(1e-6)
_TINY = np.float32(1e-30)
_LEAST = np.float32(1e-9)
_LEAST_FACING = np.float32(0.05)
_LEAST_NEAR = np.float32(1e-3)
_LEAST_ALIKE = np.float32(1e-4)
_UNLIKE = np.float32(20.0)
_BORDER = np.uint64(BORDER)


class Openness(NamedTuple):
    """Ambient occlusion: share and depths from `occlusion.OcclusionCells`; cells: cells per pixel."""

    share: np.ndarray
    depths: np.ndarray
    cells: float


class Stripe(NamedTuple):
    """Part of an image that is shaded together: ``rows`` rows from ``top``, ``span`` columns from ``begin``."""

    top: int
    rows: int
    begin: int
    span: int


@color_inline
def read_pixels(inverse, ids, stripe, scratch):
    """Fill row DEPTH, and ``keys`` with the ids of the stripe's pixels, -1 for the background."""
    pixels = scratch.pixels
    keys = scratch.keys
    begin = np.uint64(stripe.begin)
    for r in range(stripe.rows):
        y = np.uint64(stripe.top + r)
        at = np.uint64(r * stripe.span)
        for k in range(np.uint64(stripe.span)):
            w = inverse[y, begin + k]
            tag = ids[y, begin + k]
            pixels[at + k + DEPTH] = _ONE / max(w, _FARTHEST)
            keys[at + k] = tag if w > _ZERO else np.int32(-1)


@color_inline
def find_runs(stripe, scratch):
    """Fill START and ROW of ``runs``, and START of one more with the number of pixels; returns the number of runs."""
    keys = scratch.keys
    runs = scratch.runs
    count = np.uint64(0)
    for r in range(stripe.rows):
        first = r * stripe.span
        before = np.int32(-2)
        for p in range(np.uint64(first), np.uint64(first + stripe.span)):
            key = keys[p]
            runs[count + START] = p
            runs[count + ROW] = r
            count += np.uint64(key != before)
            before = key
    runs[count + START] = stripe.rows * stripe.span
    return np.int64(count)


@color_inline
def slope_down(inv, shape, stripe, row):
    """Slope upwards of the rays of a row of the stripe; ``inv`` is 1 / focal length [1/px]."""
    return (0.5 * shape[0] - (stripe.top + row) - 0.5) * inv


@color_inline
def column_shift(shape, stripe, row):
    """What to add to a pixel of the stripe for its distance from the middle of the image's row [px]."""
    return stripe.begin - row * stripe.span + 0.5 - 0.5 * shape[1]


@color_inline
def _write_node(numbers, face, nodes, u, v, depth, n):
    """Write what is known of node ``n`` before `aim_nodes`: its ray (u, v) and depth [m], normal, gloss, sides."""
    nodes[n + X] = u
    nodes[n + Y] = v
    nodes[n + Z] = depth
    # The factors of the depth are 0 on flat faces. Asking for them costs more than these products.
    for r in range(3):
        at = np.uint64(r)
        nodes[n + NX + np.uint64(r * NODE_ROW)] = numbers[face + A + at] + depth * (
            numbers[face + B + at] * u
            + numbers[face + C + at] * v
            + numbers[face + D + at]
        )
    nodes[n + GLOSS] = numbers[face + FACE_GLOSS]
    nodes[n + FACING] = numbers[face + FLAT]


@color_inline
def place_nodes(surface, poses, home, looks, lens, shape, stripe, scratch, count, stride):
    """Fill the rest of the first ``count`` runs, SLOT aside, and place their nodes.

    Returns:
        The number of nodes, and of textured runs, which ``textured`` lists.
    """
    runs = scratch.runs
    pixels = scratch.pixels
    views = scratch.faces
    inv = 1.0 / lens.focal
    nodes = np.uint64(0)
    textured = np.uint64(0)
    for run in range(np.uint64(count)):
        start = np.int64(runs[run + START])
        key = scratch.keys[start]
        if key < 0:
            runs[run + FACE] = -1
            continue
        row = np.int64(runs[run + ROW])
        v = slope_down(inv, shape, stripe, row)
        shift = column_shift(shape, stripe, row)
        last = np.int64(runs[run + np.uint64(1) + START]) - 1
        at = start
        if last - start < SHORT_RUN:
            at = (start + last + 1) // 2
            last = at
        depth = np.float64(pixels[np.uint64(at) + DEPTH])
        u = (at + shift) * inv
        face = view_face(surface, poses, home, looks, lens, scratch, key, u, v, depth)
        runs[run + FACE] = face
        runs[run + NODE] = nodes
        scratch.textured[textured] = run
        textured += np.uint64(views.numbers[face + KIND] != PLAIN)
        while True:
            _write_node(
                views.numbers,
                face,
                scratch.nodes,
                np.float32(u),
                np.float32(v),
                np.float32(depth),
                nodes,
            )
            nodes += np.uint64(1)
            if at == last:
                break
            at = min(at + stride, last)
            depth = np.float64(pixels[np.uint64(at) + DEPTH])
            u = (at + shift) * inv
    return np.int64(nodes), np.int64(textured)


@color_inline
def _aim(lens, nodes, count):
    """Compute points, directions to the camera, and unit normals, which flat faces turn to the camera.

    Before, rows X, Y, Z hold the ray (u, v) and the depth [m], and FACING is 1 on flat faces, else 0.
    """
    m = lens.mat
    right_x = np.float32(m[0, 0])
    right_y = np.float32(m[1, 0])
    right_z = np.float32(m[2, 0])
    up_x = np.float32(m[0, 1])
    up_y = np.float32(m[1, 1])
    up_z = np.float32(m[2, 1])
    back_x = np.float32(m[0, 2])
    back_y = np.float32(m[1, 2])
    back_z = np.float32(m[2, 2])
    cam_x = np.float32(lens.pos[0])
    cam_y = np.float32(lens.pos[1])
    cam_z = np.float32(lens.pos[2])
    for n in range(np.uint64(count)):
        u = nodes[n + X]
        v = nodes[n + Y]
        depth = nodes[n + Z]
        rx = right_x * u + up_x * v - back_x
        ry = right_y * u + up_y * v - back_y
        rz = right_z * u + up_z * v - back_z
        inv = -_ONE / np.sqrt(rx * rx + ry * ry + rz * rz)
        vx = rx * inv
        vy = ry * inv
        vz = rz * inv
        nx = nodes[n + NX]
        ny = nodes[n + NY]
        nz = nodes[n + NZ]
        unit = _ONE / np.sqrt(nx * nx + ny * ny + nz * nz + _TINY)
        facing = (nx * vx + ny * vy + nz * vz) * unit
        turn = nodes[n + FACING] if facing < _ZERO else _ZERO
        unit = unit - (turn + turn) * unit
        facing = facing - (turn + turn) * facing
        nodes[n + X] = cam_x + rx * depth
        nodes[n + Y] = cam_y + ry * depth
        nodes[n + Z] = cam_z + rz * depth
        nodes[n + NX] = nx * unit
        nodes[n + NY] = ny * unit
        nodes[n + NZ] = nz * unit
        nodes[n + VX] = vx
        nodes[n + VY] = vy
        nodes[n + VZ] = vz
        nodes[n + FACING] = facing
        nodes[n + SLANT] = _ONE / np.sqrt(max(facing, _LEAST_FACING))


@color_inline
def _find_cells(lens, shape, openness, scratch, count):
    """Find the four cells of ambient occlusion around each node: their shares and depths, and rows VY, VZ between."""
    nodes = scratch.nodes
    cell_at = scratch.cell_at
    share = openness.share
    depths = openness.depths
    height, width = share.shape
    focal = np.float32(lens.focal)
    scale = np.float32(openness.cells)
    middle_y = _HALF * np.float32(shape[0])
    middle_x = _HALF * np.float32(shape[1])
    last_y = np.int32(height - 1)
    last_x = np.int32(width - 1)
    for n in range(np.uint64(count)):
        fy = max((middle_y - nodes[n + Y] * focal) * scale - _HALF, _ZERO)
        fx = max((middle_x + nodes[n + X] * focal) * scale - _HALF, _ZERO)
        i = min(np.int32(fy), last_y)
        j = min(np.int32(fx), last_x)
        nodes[n + VY] = fy - np.float32(i)
        nodes[n + VZ] = fx - np.float32(j)
        cell_at[n] = i
        cell_at[n + np.uint64(MOST_NODES)] = j
    for n in range(np.uint64(count)):
        ya = np.uint64(cell_at[n])
        xa = np.uint64(cell_at[n + np.uint64(MOST_NODES)])
        yb = min(ya + np.uint64(1), np.uint64(height - 1))
        xb = min(xa + np.uint64(1), np.uint64(width - 1))
        nodes[n + _SHARES[0]] = share[ya, xa]
        nodes[n + _SHARES[1]] = share[ya, xb]
        nodes[n + _SHARES[2]] = share[yb, xa]
        nodes[n + _SHARES[3]] = share[yb, xb]
        ya += _BORDER
        yb += _BORDER
        xa += _BORDER
        xb += _BORDER
        nodes[n + _DEPTHS[0]] = depths[ya, xa]
        nodes[n + _DEPTHS[1]] = depths[ya, xb]
        nodes[n + _DEPTHS[2]] = depths[yb, xa]
        nodes[n + _DEPTHS[3]] = depths[yb, xb]


@color_inline
def _weight(near, inverse_depth, depth):
    """Weight of a cell: by its nearness 0..1 and by how well its depth is that of the node."""
    off = abs(inverse_depth * depth - _ONE)
    return (near + _LEAST_NEAR) * (_LEAST_ALIKE + max(_ZERO, _ONE - _UNLIKE * off))


@color_inline
def _open(nodes, count):
    """Fill row OPEN from the four cells that `_find_cells` found."""
    for n in range(np.uint64(count)):
        fy = nodes[n + VY]
        fx = nodes[n + VZ]
        depth = nodes[n + Z]
        gy = _ONE - fy
        gx = _ONE - fx
        a = _weight(gy * gx, nodes[n + _DEPTHS[0]], depth)
        b = _weight(gy * fx, nodes[n + _DEPTHS[1]], depth)
        c = _weight(fy * gx, nodes[n + _DEPTHS[2]], depth)
        d = _weight(fy * fx, nodes[n + _DEPTHS[3]], depth)
        total = (
            a * nodes[n + _SHARES[0]]
            + b * nodes[n + _SHARES[1]]
            + c * nodes[n + _SHARES[2]]
            + d * nodes[n + _SHARES[3]]
        )
        nodes[n + OPEN] = total / (a + b + c + d + _LEAST)


@color_inline
def aim_nodes(lens, shape, openness, scratch, count):
    """Compute rows X to FACING of the first ``count`` nodes, and SLANT, from what `place_nodes` wrote."""
    _find_cells(lens, shape, openness, scratch, count)
    _open(scratch.nodes, count)
    _aim(lens, scratch.nodes, count)
