"""Light of colour images: bytes and what they show, and changes of it; all in place, compiled at their first use."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from mjhab.scenes.shapes.colors import srgb_to_linear

_KNEE = 0.6
"""Linear light above which pictures are compressed, see `shading.tone_curve`."""


class Tones(NamedTuple):
    """Bytes of colour images and the light of the scene that they show, without the compression of highlights.

    Attributes:
        light_of: (256,) float32.
        bytes_of: (n,) uint8 by light.
        scale: entries of ``bytes_of`` per unit of light.
    """

    light_of: np.ndarray
    bytes_of: np.ndarray
    scale: np.float32


@cache
def tones() -> Tones:
    """The one of all pictures."""
    from mjhab.render.raster.shading import TONE_RANGE, tone_curve  # loads numba

    bytes_of = tone_curve()
    shown = srgb_to_linear(np.arange(256) / 255.0)
    over = np.minimum((shown - _KNEE) / (1.0 - _KNEE), 1.0 - 1e-9)
    bright = _KNEE - (1.0 - _KNEE) * np.log1p(-np.maximum(over, 0.0))
    light = np.minimum(np.where(over > 0.0, bright, shown), TONE_RANGE)
    scale = np.float32((len(bytes_of) - 1) / TONE_RANGE)
    return Tones(light.astype(np.float32), bytes_of, scale)


def relight(
    rgb: np.ndarray,
    depth: np.ndarray,
    focal: float,
    toward: np.ndarray,
    side: float,
    gain: np.ndarray,
) -> None:
    """Change the light of an image (h, w, 3) uint8.

    Args:
        rgb: the image.
        depth: (h, w) float32 planar distances [m], 0 where nothing is hit.
        focal: focal length [px].
        toward: (3,) unit vector to the light in the axes of the camera (x right, y up, z backwards).
        side: share of the light that comes from there, 0 to 1.
        gain: (3,) factors of red, green and blue.
    """
    from mjhab.envs.perturbations import kernels  # loads numba

    numbers = (np.float32(focal), toward.astype(np.float32), np.float32(side))
    kernels.relight(rgb, depth, *numbers, gain.astype(np.float32), *tones())


def recolour(rgb: np.ndarray, seg: np.ndarray, mixes: np.ndarray) -> None:
    """Mix the linear light of an image (h, w, 3) uint8 by segments.

    Args:
        rgb: the image.
        seg: (h, w) int32 segments.
        mixes: (n, 3, 3) float32, matrix of segment i modulo n.
    """
    from mjhab.envs.perturbations import kernels  # loads numba

    kernels.recolour(rgb, seg, mixes, *tones())


def blur(rgb: np.ndarray, sigma: float) -> None:
    """Blur an image (h, w, 3) uint8 as a lens does that is out of focus; ``sigma`` of the Gauss bell [px]."""
    from mjhab.envs.perturbations import kernels  # loads numba

    radius = max(1, int(np.ceil(2.5 * sigma)))
    weights = np.exp(-0.5 * np.square(np.arange(-radius, radius + 1) / sigma))
    kernels.blur(rgb, (weights / weights.sum()).astype(np.float32), *tones())
