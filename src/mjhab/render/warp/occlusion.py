# type: ignore
# ruff: noqa: UP018
# Kernels are written in Warp's language, which has Python's syntax but its own types. A variable that changes must be
# made by float() or int(); otherwise Warp treats it as a constant.
"""Kernels of screen-space ambient occlusion on cells of pixels, as in ``raster.occlusion`` on the CPU."""

from __future__ import annotations

import warp as wp

from mjhab.render.raster import occlusion
from mjhab.render.warp.looks import SceneArrays
from mjhab.render.warp.tracing import TracedFrame, TracedWorlds, is_drawn

wp.set_module_options({"enable_backward": False})

AO_RADIUS = wp.constant(occlusion.RADIUS)
AO_STRENGTH = wp.constant(occlusion.STRENGTH)
AO_TAPS = wp.constant(occlusion.TAPS)


@wp.struct
class Cells:
    """Ambient occlusion of K worlds on cells of ``cell`` x ``cell`` pixels; all arrays are (K, C, height * width).

    raw: occlusion 0..1 before blurring. share: openness 0.15..1 (1: not occluded). depths: inverse depth [1/m]. width,
    height: number of cells.
    """

    raw: wp.array3d[float]
    share: wp.array3d[float]
    depths: wp.array3d[float]
    width: int
    height: int
    cell: int


@wp.func
def _slope(inverse: wp.array3d[float], k: int, c: int, at: int, before: int, after: int):
    """Change of inverse depth per pixel: the smaller one-sided difference, to ignore depth edges.

    ``at``, ``before``, ``after``: indices of the pixel and its two neighbours; equal to ``at`` outside of the image.
    """
    w = inverse[k, c, at]
    forward = inverse[k, c, after] - w
    backward = w - inverse[k, c, before]
    if after == at:
        return backward
    if before == at:
        return forward
    return wp.where(wp.abs(forward) < wp.abs(backward), forward, backward)


@wp.kernel
def block_cells(
    looks: SceneArrays, worlds: TracedWorlds, frame: TracedFrame, cells: Cells, first: int
):
    """Compute ``raw`` and ``depths`` of the K worlds from ``first`` on, at the middle pixel of every cell."""
    k, c, at = wp.tid()
    if not is_drawn(worlds, first + k):
        return
    i = at // cells.width
    j = at % cells.width
    y = wp.min(i * cells.cell + cells.cell // 2, frame.height - 1)
    x = wp.min(j * cells.cell + cells.cell // 2, frame.width - 1)
    pixel = y * frame.width + x
    w = frame.inverse[k, c, pixel]
    cells.depths[k, c, at] = w
    cells.raw[k, c, at] = 0.0
    if w <= 0.0:
        return
    focal = frame.focal[c]
    turn = (i & 3) * 4 + (j & 3)
    cx = 0.5 * float(frame.width)
    cy = 0.5 * float(frame.height)
    left = pixel - wp.min(x, 1)
    right = pixel + wp.min(frame.width - 1 - x, 1)
    up = pixel - frame.width * wp.min(y, 1)
    down = pixel + frame.width * wp.min(frame.height - 1 - y, 1)
    gx = _slope(frame.inverse, k, c, pixel, left, right)
    gy = _slope(frame.inverse, k, c, pixel, up, down)
    u = float(x) + 0.5 - cx
    v = float(y) + 0.5 - cy
    n = wp.vec3(-gx * focal, -gy * focal, -(w - gx * u - gy * v))
    n = n / wp.sqrt(wp.dot(n, n) + 1.0e-20)
    z = 1.0 / w
    p = wp.vec3(u / focal * z, v / focal * z, z)
    reach = wp.min(AO_RADIUS * focal * w, 0.2 * float(frame.height))
    total = float(0.0)
    for tap in range(AO_TAPS):
        offset = looks.disk[turn, tap]
        col = int(float(x) + 0.5 + reach * offset[0])
        row = int(float(y) + 0.5 + reach * offset[1])
        if col < 0 or row < 0 or col >= frame.width or row >= frame.height:
            continue
        other = frame.inverse[k, c, row * frame.width + col]
        if other <= 0.0:
            continue
        qz = 1.0 / other
        d = (
            wp.vec3(
                (float(col) + 0.5 - cx) / focal * qz,
                (float(row) + 0.5 - cy) / focal * qz,
                qz,
            )
            - p
        )
        square = wp.dot(d, d)
        if square < AO_RADIUS * AO_RADIUS:
            rise = wp.max(wp.dot(d, n) - 0.004 * z, 0.0)
            total += (
                rise / wp.sqrt(square + 1.0e-4) * (1.0 - square / (AO_RADIUS * AO_RADIUS))
            )
    cells.raw[k, c, at] = total / float(AO_TAPS)


@wp.kernel
def blur_cells(worlds: TracedWorlds, cells: Cells, first: int):
    """Compute ``share`` of every cell from the mean ``raw`` of the 4 x 4 cells around it that have similar depth."""
    k, c, at = wp.tid()
    if not is_drawn(worlds, first + k):
        return
    i = at // cells.width
    j = at % cells.width
    depth = cells.depths[k, c, at]
    total = float(0.0)
    weight = float(1.0e-9)
    for y in range(wp.max(i - 2, 0), wp.min(i + 2, cells.height)):
        for x in range(wp.max(j - 2, 0), wp.min(j + 2, cells.width)):
            near = y * cells.width + x
            if wp.abs(cells.depths[k, c, near] - depth) < 0.05 * depth:
                total += cells.raw[k, c, near]
                weight += 1.0
    cells.share[k, c, at] = wp.max(1.0 - AO_STRENGTH * total / weight, 0.15)


@wp.func
def _openness(cells: Cells, k: int, c: int, row: float, col: float, depth: float):
    """Openness at a position (row, col in cells) and depth [m]: bilateral interpolation of the four nearest cells."""
    y = wp.max(row - 0.5, 0.0)
    x = wp.max(col - 0.5, 0.0)
    i = wp.min(int(y), cells.height - 1)
    j = wp.min(int(x), cells.width - 1)
    fy = y - float(i)
    fx = x - float(j)
    total = float(0.0)
    weight = float(1.0e-9)
    for corner in range(4):
        r = corner // 2
        q = corner % 2
        at = wp.min(i + r, cells.height - 1) * cells.width + wp.min(
            j + q, cells.width - 1
        )
        w = wp.where(r == 1, fy, 1.0 - fy) * wp.where(q == 1, fx, 1.0 - fx) + 1.0e-3
        w = w * (
            1.0e-4
            + wp.max(0.0, 1.0 - 20.0 * wp.abs(cells.depths[k, c, at] * depth - 1.0))
        )
        total += w * cells.share[k, c, at]
        weight += w
    return total / weight


@wp.func
def open_share_at(
    cells: Cells, frame: TracedFrame, k: int, c: int, pixel: int, depth: float
):
    """Openness 0.15..1 at a pixel (row * width + column) whose depth is given [m]."""
    row = (float(pixel // frame.width) + 0.5) / float(cells.cell)
    column = (float(pixel % frame.width) + 0.5) / float(cells.cell)
    return _openness(cells, k, c, row, column, depth)
