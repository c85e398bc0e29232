"""Kernels of perturbed images: one pass over the pixels of all cameras of a world.

Light is that of the scene (see `pixels.Tones`): ``light_of`` (256,) float32 of each byte, ``bytes_of`` (n,) uint8 by
light, ``scale`` entries of these per unit of light.
"""

from __future__ import annotations

import numpy as np

from mjhab.core.kernels.jit import compiler

_MODULE = "envs.perturbations.kernels"
# There is no NaN in images, and without care for it and for signed zeros loops are vectorised.
_NUMBERS = {"nnan", "nsz"}
_helper = compiler(_MODULE, forceinline=True, fastmath=_NUMBERS)
_kernel = compiler(_MODULE, fastmath=_NUMBERS)

CELL_PX = 2
"""Side [px] of the cells of an image that face the light as one: half of all corners of things are in whole cells."""
EDGE = np.float32(0.1)
"""Neighbouring pixels whose distances differ by more than this share of them show different things."""
OTHER = 255
"""Entry of a cell that shows no surface."""
SHADOW_PX = 4
"""Distance [px] of the points of an image for which shadows are looked for; between them they are soft."""
SHADOW_M = tuple(np.float32(way) for way in 0.05 * 1.6 ** np.arange(7))
"""Where on the way to the light something may stand [m]."""
CLEAR = np.float32(0.015)
THICK = np.float32(0.4)
"""What stands in the way is nearer to the camera than the way is, by more than CLEAR [m], times 1 + distance [m], and
by less than THICK [m], beyond which light passes behind it."""
NEAREST = np.float32(0.05)
"""Ways that come so near to the camera [m] are not followed."""
HOLE_PX = 2
"""Side of the smallest hole in a depth image [px]; neighbouring ones make larger holes."""
ONE = 256
"""Sum of the weights of a blur."""


@_helper
def _faced(upper, lower, v, inv, toward, entry, most):
    """Write the entry of a table for every cell of two rows of pixels: how much what it shows faces the light.

    upper, lower: (w,) float32 [m]. v: of the upper row, as tangent. entry: (cells,) uint8. most: the last entry. A cell
    across an edge, or where nothing is hit, has that of the one before it.
    """
    half = np.float32(0.5 * len(upper) - 0.5)
    zero = np.float32(0.0)
    top = np.float32(most)
    # Without branches, so that many cells are computed at once.
    for cell in range(len(upper) // CELL_PX):
        x = np.uint64(CELL_PX) * np.uint64(cell)
        d = upper[x]
        e = upper[x + np.uint64(1)]
        f = lower[x]
        u = (np.float32(CELL_PX) * np.float32(np.int32(cell)) - half) * inv
        # To the pixel on the right, and down to the one below.
        ax = (e - d) * u + e * inv
        ay = (e - d) * v
        az = d - e
        bx = (f - d) * u
        by = (f - d) * v - f * inv
        bz = d - f
        nx = by * az - bz * ay
        ny = bz * ax - bx * az
        nz = bx * ay - by * ax
        # Never 0: a cell that is seen edge on has no normal.
        square = nx * nx + ny * ny + nz * nz + np.float32(1e-24)
        along = nx * toward[0] + ny * toward[1] + nz * toward[2]
        # Turned away from the light is as dark as edge on.
        share = max(along / np.sqrt(square), zero) * top + np.float32(0.5)
        step = max(max(d, e), f) - min(min(d, e), f)
        entry[cell] = np.uint8(np.int32(share if step < EDGE * d else np.float32(OTHER)))
    # A cell across an edge shows no surface of its own.
    last = np.uint8(0)
    for cell in range(len(upper) // CELL_PX):
        last = entry[cell] if entry[cell] != OTHER else last
        entry[cell] = last


@_helper
def _reached(depth, focal, toward, lit):
    """Write which points of an image the light reaches, 0 or 1, as far as the image shows what stands in its way.

    depth: (h, w) float32 [m]. lit: (rows, columns) float32, of every pixel whose row and column are multiples of
    SHADOW_PX, or the last one.
    """
    height, width = depth.shape
    inv = np.float32(1.0) / focal
    zero, one, half = np.float32(0.0), np.float32(1.0), np.float32(0.5)
    half_x = np.float32(0.5 * width - 0.5)
    half_y = np.float32(0.5 * height - 0.5)
    for row in range(lit.shape[0]):
        y = min(row * SHADOW_PX, height - 1)
        for column in range(lit.shape[1]):
            x = min(column * SHADOW_PX, width - 1)
            d = depth[y, x]
            lit[row, column] = one
            if d <= zero:
                continue
            right = (np.float32(x) - half_x) * inv * d
            up = (half_y - np.float32(y)) * inv * d
            for way in SHADOW_M:
                far = d - way * toward[2]
                if far < NEAREST:
                    break
                scale = focal / far
                i = np.int32((right + way * toward[0]) * scale + half_x + half)
                j = np.int32(half_y - (up + way * toward[1]) * scale + half)
                if i < 0 or j < 0 or i >= width or j >= height:
                    break
                gap = far - depth[j, i]
                if gap > CLEAR * (one + d) and gap < THICK and depth[j, i] > zero:
                    lit[row, column] = zero
                    break


@_helper
def _shadowed(lit, y, entry):
    """Take the light that does not reach them from the entries of a row of cells, softly between points of ``lit``.

    y: row of the cells' first pixels. entry: see `_faced`.
    """
    row = y // SHADOW_PX
    upper = lit[row]
    lower = lit[min(row + (y % SHADOW_PX) // CELL_PX, lit.shape[0] - 1)]
    half = np.float32(0.5)
    for column in range(lit.shape[1]):
        here = half * (upper[column] + lower[column])
        after = min(column + 1, lit.shape[1] - 1)
        there = half * (upper[after] + lower[after])
        if here + there == np.float32(2.0):
            continue
        cell = column * (SHADOW_PX // CELL_PX)
        if cell < len(entry):
            entry[cell] = np.uint8(np.float32(entry[cell]) * here + half)
        if cell + 1 < len(entry):
            share = half * (here + there)
            entry[cell + 1] = np.uint8(np.float32(entry[cell + 1]) * share + half)


@_kernel
def relight(rgb, depth, focal, toward, table, shadows):
    """Change the light of C images in place.

    rgb: (C, h, w, 3) uint8. depth: (C, h, w) float32 [m], at least CELL_PX on a side. focal: (C,) float32 [px]. toward:
    (C, 3) float32 unit vectors to the light in the axes of the cameras. table: (n, 3, 256) uint8, of red, green and
    blue by how much surfaces face the light, from 0 to 1. shadows: whether what the images show throws some.
    """
    cameras, height, width = depth.shape
    cells = width // CELL_PX
    # One more for the last column of an odd width.
    entry = np.empty(cells + 1, np.uint8)
    flat = table.reshape(table.size)
    points = (height - 2) // SHADOW_PX + 2, (width - 2) // SHADOW_PX + 2
    lit = np.empty(points, np.float32)
    for camera in range(cameras):
        inv = np.float32(1.0) / focal[camera]
        if shadows:
            _reached(depth[camera], focal[camera], toward[camera], lit)
        for y in range(0, height, CELL_PX):
            # The last row of an odd image belongs to the cells above it, as its last column to those beside it.
            if y + 1 < height:
                v = np.float32(0.5 * height - 0.5 - y) * inv
                upper, lower = depth[camera, y], depth[camera, y + 1]
                _faced(upper, lower, v, inv, toward[camera], entry, len(table) - 1)
                if shadows:
                    _shadowed(lit, y, entry)
                entry[cells] = entry[cells - 1]
            for row in range(y, min(y + CELL_PX, height)):
                line = rgb[camera, row]
                for column in range(width):
                    i = np.uint64(column)
                    # 3 tables of 256 bytes lie behind each other.
                    at = np.uint64(entry[i // np.uint64(CELL_PX)]) * np.uint64(768)
                    line[i, 0] = flat[at + np.uint64(line[i, 0])]
                    line[i, 1] = flat[at + np.uint64(256) + np.uint64(line[i, 1])]
                    line[i, 2] = flat[at + np.uint64(512) + np.uint64(line[i, 2])]


@_kernel
def recolour(rgb, seg, mixes, light_of, bytes_of, scale):
    """Mix the colours of C images by segments, in place.

    rgb: (C, h, w, 3) uint8. seg: (C, h, w) int32. mixes: (n, 3, 3) float32, of segment i modulo n.
    """
    cameras, height, width = seg.shape
    top = np.float32(len(bytes_of) - 1)
    zero = np.float32(0.0)
    half = np.float32(0.5)
    for camera in range(cameras):
        for y in range(height):
            for x in range(width):
                mix = mixes[seg[camera, y, x] % len(mixes)]
                r = light_of[rgb[camera, y, x, 0]]
                g = light_of[rgb[camera, y, x, 1]]
                b = light_of[rgb[camera, y, x, 2]]
                for c in range(3):
                    light = mix[c, 0] * r + mix[c, 1] * g + mix[c, 2] * b
                    entry = min(max(light * scale, zero), top)
                    rgb[camera, y, x, c] = bytes_of[np.int32(entry + half)]


@_helper
def _begin(middle, weight, total):
    """Begin the sums of a row of bytes by those in the middle, with a half that rounds."""
    for x in range(len(total)):
        total[x] = np.uint16(ONE // 2) + weight * middle[x]


@_helper
def _add(one, other, weight, total):
    """Add two neighbours of the same weight to the sums of a row."""
    for x in range(len(total)):
        total[x] += weight * (one[x] + other[x])


@_kernel
def blur(rgb, weights):
    """Blur C images in place, rows and columns in turn.

    rgb: (C, h, w, 3) uint8. weights: (2 r + 1,) uint16, symmetric with the sum ONE, of the neighbours from -r to r;
    edges go on as they are.
    """
    cameras, height, width, _ = rgb.shape
    radius = len(weights) // 2
    length = 3 * width
    # Sums of bytes by weights fit into 16 bits, of which a processor adds many at once.
    wide = np.empty(length + 6 * radius, np.uint16)
    rows = np.empty((height + 2 * radius, length), np.uint16)
    total = np.empty(length, np.uint16)
    for camera in range(cameras):
        image = rgb[camera].reshape(height, length)
        for y in range(height):
            for x in range(length):
                wide[3 * radius + x] = image[y, x]
            for x in range(3 * radius):
                wide[x] = image[y, x % 3]
                wide[length + 3 * radius + x] = image[y, length - 3 + x % 3]
            _begin(wide[3 * radius :], weights[radius], total)
            for k in range(1, radius + 1):
                left, right = wide[3 * (radius - k) :], wide[3 * (radius + k) :]
                _add(left, right, weights[radius + k], total)
            for x in range(length):
                rows[radius + y, x] = total[x] >> np.uint16(8)
        for y in range(radius):
            rows[y] = rows[radius]
            rows[height + radius + y] = rows[height + radius - 1]
        for y in range(height):
            _begin(rows[radius + y], weights[radius], total)
            for k in range(1, radius + 1):
                above, below = rows[radius + y - k], rows[radius + y + k]
                _add(above, below, weights[radius + k], total)
            for x in range(length):
                image[y, x] = np.uint8(total[x] >> np.uint16(8))


@_helper
def _mixed(number):
    """A number of 64 bits whose bits all depend on those of another one (splitmix64)."""
    number = (number ^ (number >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    number = (number ^ (number >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return number ^ (number >> np.uint64(31))


@_kernel
def holes(images, key, step, share):
    """Write zeros into squares of C images, in place.

    images: (C, h, w), any kind of number. key: uint64 of the episode. step: control step. share: of the squares.
    """
    cameras, height, width = images.shape
    # 32 bits are compared, which tell shares apart to 2e-10.
    limit = np.uint64(share * 2.0**32)
    counter = _mixed(key ^ _mixed(np.uint64(step) + np.uint64(1)))
    for camera in range(cameras):
        for y in range(0, height, HOLE_PX):
            for x in range(0, width, HOLE_PX):
                # The golden ratio of 64 bits, with which splitmix64 counts: no two squares get the same number.
                counter += np.uint64(0x9E3779B97F4A7C15)
                if (_mixed(counter) >> np.uint64(32)) >= limit:
                    continue
                for row in range(y, min(y + HOLE_PX, height)):
                    for column in range(x, min(x + HOLE_PX, width)):
                        images[camera, row, column] = 0


@_kernel
def steps(depth, step):
    """Round all distances (C, h, w) float32 to multiples of ``step`` float32 [m], in place."""
    flat = depth.reshape(depth.size)
    # Multiplying is faster than dividing, and vectorised.
    per = np.float32(1.0) / step
    for i in range(len(flat)):
        flat[i] = np.rint(flat[i] * per) * step
