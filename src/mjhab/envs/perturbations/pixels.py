"""Pixels of images: linear light of sRGB bytes and back, surfaces in depth images, blur."""

from __future__ import annotations

from functools import cache

import numpy as np

from mjhab.scenes.shapes.colors import srgb_to_linear

_KNEE = 0.6
"""Linear light above which pictures are compressed, see `shading.tone_curve`."""


@cache
def _tables() -> tuple[np.ndarray, np.ndarray, float]:
    """Light of the scene (256,) float32 of each byte, bytes by light, and entries of these per unit of light."""
    from mjhab.render.raster.shading import TONE_RANGE, tone_curve  # loads numba

    bytes_of = tone_curve()
    shown = srgb_to_linear(np.arange(256) / 255.0)
    over = np.minimum((shown - _KNEE) / (1.0 - _KNEE), 1.0 - 1e-9)
    bright = _KNEE - (1.0 - _KNEE) * np.log1p(-np.maximum(over, 0.0))
    light = np.minimum(np.where(over > 0.0, bright, shown), TONE_RANGE)
    return light.astype(np.float32), bytes_of, (len(bytes_of) - 1) / TONE_RANGE


def to_linear(rgb: np.ndarray) -> np.ndarray:
    """Light (...) float32 that the bytes (...) uint8 of a colour image show, without the compression of highlights."""
    return _tables()[0][rgb]


def from_linear(light: np.ndarray) -> np.ndarray:
    """Bytes (...) uint8 of a colour image that shows light (...) float32 from 0, highlights compressed."""
    _, bytes_of, scale = _tables()
    entry = np.minimum(light * np.float32(scale), np.float32(len(bytes_of) - 1))
    return bytes_of[(entry + np.float32(0.5)).astype(np.int32)]


def normals(depth: np.ndarray, focal: float, toward: np.ndarray) -> np.ndarray:
    """Cosine (h, w) float32 between a direction and the surfaces of a depth image; 0 where nothing is hit.

    Args:
        depth: (h, w) float32 planar distances [m].
        focal: focal length [px].
        toward: (3,) float32 unit vector in the axes of the camera (x right, y up, z backwards).
    """
    height, width = depth.shape
    x = (np.arange(width, dtype=np.float32) + 0.5 - 0.5 * width) / np.float32(focal)
    y = (0.5 * height - np.arange(height, dtype=np.float32) - 0.5) / np.float32(focal)
    points = np.stack([depth * x, depth * y[:, None], -depth], axis=-1)
    along = np.empty_like(points)
    along[:, 1:-1] = points[:, 2:] - points[:, :-2]
    along[:, 0], along[:, -1] = along[:, 1], along[:, -2]
    up = np.empty_like(points)
    up[1:-1] = points[:-2] - points[2:]
    up[0], up[-1] = up[1], up[-2]
    normal = np.cross(along, up)
    size = np.sqrt(np.square(normal).sum(-1))
    cosine = (normal @ toward) / np.maximum(size, np.float32(1e-12))
    return np.where(depth > 0.0, cosine, np.float32(0.0))


def blurred(images: np.ndarray, sigma: float) -> np.ndarray:
    """Images (C, h, w, channels) float32 through a lens that is out of focus; ``sigma`` of the Gauss bell [px]."""
    radius = max(1, int(np.ceil(2.5 * sigma)))
    weights = np.exp(-0.5 * np.square(np.arange(-radius, radius + 1) / sigma))
    weights = (weights / weights.sum()).astype(np.float32)
    for axis in (1, 2):
        length = images.shape[axis]
        edges = [(radius, radius) if k == axis else (0, 0) for k in range(images.ndim)]
        padded = np.pad(images, edges, mode="edge")
        images = np.zeros_like(images)
        for k, weight in enumerate(weights):
            part = [slice(None)] * images.ndim
            part[axis] = slice(k, k + length)
            images += weight * padded[tuple(part)]
    return images
