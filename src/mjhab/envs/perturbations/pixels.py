"""Light of colour images: bytes and what they show, and changes of it; all in place, compiled at their first use."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from mjhab.scenes.shapes.colors import srgb_to_linear

_KNEE = 0.6
"""Linear light above which pictures are compressed, see `shading.tone_curve`."""
FACINGS = 32
"""Steps in which surfaces face the light; such a table stays in the nearest cache of a processor."""
EPISODES_KEPT = 256
"""Episodes of which each axis keeps in memory what every image needs, 40 KiB at most."""


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
    # Full white would be infinitely bright.
    over = np.minimum((shown - _KNEE) / (1.0 - _KNEE), 1.0 - 1e-9)
    bright = _KNEE - (1.0 - _KNEE) * np.log1p(-np.maximum(over, 0.0))
    light = np.minimum(np.where(over > 0.0, bright, shown), TONE_RANGE)
    scale = np.float32((len(bytes_of) - 1) / TONE_RANGE)
    return Tones(light.astype(np.float32), bytes_of, scale)


def light_table(gain: np.ndarray, side: float) -> np.ndarray:
    """What light from one side does to bytes: (FACINGS, 3, 256) uint8 of red, green and blue.

    Args:
        gain: (3,) factors of red, green and blue.
        side: share of the light that comes from one side, 0 to 1.

    Returns:
        The new byte of every byte, by how much a surface faces that side, in equal steps from 0 to 1.
    """
    light_of, bytes_of, scale = tones()
    facing = np.linspace(0.0, 1.0, FACINGS)
    # On the mean over all directions, a surface keeps its light.
    share = 1.0 - side + side * 4.0 * facing
    light = share[:, None, None] * gain[:, None] * light_of
    entry = np.minimum(light * scale + 0.5, len(bytes_of) - 1)
    return bytes_of[entry.astype(np.int64)]


def relight(
    rgb: np.ndarray,
    depth: np.ndarray,
    focal: np.ndarray,
    toward: np.ndarray,
    table: np.ndarray,
    shadows: bool,
) -> None:
    """Change the light of C images (C, h, w, 3) uint8.

    Args:
        rgb: the images.
        depth: (C, h, w) float32 planar distances [m], 0 where nothing is hit.
        focal: (C,) focal lengths [px].
        toward: (C, 3) unit vectors to the light in the axes of the cameras (x right, y up, z backwards).
        table: see `light_table`.
        shadows: whether what the images show throws shadows on what they show.
    """
    from mjhab.envs.perturbations import kernels  # loads numba

    own = focal.astype(np.float32), toward.astype(np.float32)
    kernels.relight(rgb, depth, *own, table, shadows)


def recolour(rgb: np.ndarray, seg: np.ndarray, mixes: np.ndarray) -> None:
    """Mix the linear light of C images (C, h, w, 3) uint8 by segments.

    Args:
        rgb: the images.
        seg: (C, h, w) int32 segments.
        mixes: (n, 3, 3) float32, matrix of segment i modulo n.
    """
    from mjhab.envs.perturbations import kernels  # loads numba

    kernels.recolour(rgb, seg, mixes, *tones())


def blur(rgb: np.ndarray, sigma: float) -> None:
    """Blur C images (C, h, w, 3) uint8 as shaken ones; ``sigma`` of the Gauss bell [px]."""
    from mjhab.envs.perturbations import kernels  # loads numba

    kernels.blur(rgb, _bell(sigma))


@cache
def _bell(sigma: float) -> np.ndarray:
    """(2 r + 1,) uint16 weights of neighbours with the sum `kernels.ONE`."""
    from mjhab.envs.perturbations.kernels import ONE  # loads numba

    radius = max(1, int(np.ceil(2.5 * sigma)))
    bell = np.exp(-0.5 * np.square(np.arange(-radius, radius + 1) / sigma))
    weights = np.rint(ONE * bell / bell.sum()).astype(np.int64)
    # What rounding took goes to the middle, so that a blur keeps the brightness.
    weights[radius] += ONE - weights.sum()
    return weights.astype(np.uint16)


def holes(images: np.ndarray, key: np.uint64, step: int, share: float) -> None:
    """Write zeros into squares of C images (C, h, w), any kind of number.

    Args:
        images: the images; others of the same shape get the same holes.
        key: of the episode.
        step: control steps since its start.
        share: of the squares.
    """
    from mjhab.envs.perturbations import kernels  # loads numba

    kernels.holes(images, key, step, share)


def rounded(depth: np.ndarray, step: float) -> None:
    """Round distances (C, h, w) float32 [m] to multiples of ``step`` [m]."""
    from mjhab.envs.perturbations import kernels  # loads numba

    kernels.steps(depth, np.float32(step))
