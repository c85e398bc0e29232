"""Kernels of perturbed images: one pass over the pixels of a camera's image.

Light is that of the scene (see `pixels.Tones`): ``light_of`` (256,) float32 of each byte, ``bytes_of`` (n,) uint8 by
light, ``scale`` entries of these per unit of light.
"""

from __future__ import annotations

import numpy as np

from mjhab.core.kernels.jit import compiler

_MODULE = "envs.perturbations.kernels"
_NUMBERS = {"nnan", "nsz"}
_helper = compiler(_MODULE, forceinline=True, fastmath=_NUMBERS)
_kernel = compiler(_MODULE, fastmath=_NUMBERS)


@_helper
def _byte(light, bytes_of, scale):
    """The byte that shows a light."""
    entry = min(light * scale, np.float32(len(bytes_of) - 1))
    return bytes_of[np.int32(entry + np.float32(0.5))]


@_helper
def _point(depth, y, x, focal):
    """The point (3,) that a pixel shows, in the axes of the camera [m]."""
    height, width = depth.shape
    d = depth[y, x]
    u = (np.float32(x) + np.float32(0.5 - 0.5 * width)) / focal
    v = (np.float32(0.5 * height - 0.5) - np.float32(y)) / focal
    return d * u, d * v, -d


@_helper
def _cosine(depth, y, x, focal, toward):
    """Cosine between a direction and the surface that a pixel shows; 0 where nothing is hit."""
    height, width = depth.shape
    if depth[y, x] <= 0.0:
        return np.float32(0.0)
    ax, ay, az = _point(depth, y, max(x - 1, 0), focal)
    bx, by, bz = _point(depth, y, min(x + 1, width - 1), focal)
    cx, cy, cz = _point(depth, min(y + 1, height - 1), x, focal)
    dx, dy, dz = _point(depth, max(y - 1, 0), x, focal)
    ax, ay, az = bx - ax, by - ay, bz - az
    dx, dy, dz = dx - cx, dy - cy, dz - cz
    nx = ay * dz - az * dy
    ny = az * dx - ax * dz
    nz = ax * dy - ay * dx
    size = np.sqrt(nx * nx + ny * ny + nz * nz)
    along = nx * toward[0] + ny * toward[1] + nz * toward[2]
    return along / max(size, np.float32(1e-12))


@_kernel
def relight(rgb, depth, focal, toward, side, gain, light_of, bytes_of, scale):
    """Change the light of an image in place.

    rgb: (h, w, 3) uint8. depth: (h, w) float32 [m]. focal: [px]. toward: (3,) float32 unit vector to the light in the
    axes of the camera. side: share of the light that comes from there. gain: (3,) float32.
    """
    height, width = depth.shape
    one = np.float32(1.0)
    for y in range(height):
        for x in range(width):
            facing = max(_cosine(depth, y, x, focal, toward), np.float32(0.0))
            # On the mean over all directions, a surface keeps its light.
            share = one - side + side * np.float32(4.0) * facing
            for c in range(3):
                light = light_of[rgb[y, x, c]] * share * gain[c]
                rgb[y, x, c] = _byte(light, bytes_of, scale)


@_kernel
def recolour(rgb, seg, mixes, light_of, bytes_of, scale):
    """Mix the colours of an image by segments, in place.

    rgb: (h, w, 3) uint8. seg: (h, w) int32. mixes: (n, 3, 3) float32, of segment i modulo n.
    """
    height, width = seg.shape
    for y in range(height):
        for x in range(width):
            mix = mixes[seg[y, x] % len(mixes)]
            r = light_of[rgb[y, x, 0]]
            g = light_of[rgb[y, x, 1]]
            b = light_of[rgb[y, x, 2]]
            for c in range(3):
                light = mix[c, 0] * r + mix[c, 1] * g + mix[c, 2] * b
                rgb[y, x, c] = _byte(max(light, np.float32(0.0)), bytes_of, scale)


@_kernel
def blur(rgb, weights, light_of, bytes_of, scale):
    """Blur an image in place, rows and columns in turn.

    rgb: (h, w, 3) uint8. weights: (2 r + 1,) float32, of the neighbours from -r to r; edges go on as they are.
    """
    height, width, _ = rgb.shape
    radius = len(weights) // 2
    rows = np.empty((height, width, 3), np.float32)
    for y in range(height):
        for x in range(width):
            for c in range(3):
                light = np.float32(0.0)
                for k in range(len(weights)):
                    at = min(max(x + k - radius, 0), width - 1)
                    light += weights[k] * light_of[rgb[y, at, c]]
                rows[y, x, c] = light
    for y in range(height):
        for x in range(width):
            for c in range(3):
                light = np.float32(0.0)
                for k in range(len(weights)):
                    at = min(max(y + k - radius, 0), height - 1)
                    light += weights[k] * rows[at, x, c]
                rgb[y, x, c] = _byte(light, bytes_of, scale)
