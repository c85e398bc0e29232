"""Procedural patterns of surfaces, baked into tileable images.

The first channel of an image is the blend factor between the material's two colours (0: first, 255: second). The second
is a factor on the blended colour, in steps of ``SHADE_TOP / 255``.
"""

from __future__ import annotations

import numpy as np

PERIODS: dict[str, tuple[float, float]] = {
    "wood": (16.0, 8.0),
    "planks": (32.0, 16.0),
    "tiles": (4.0, 4.0),
    "fabric": (8.0, 8.0),
    "stripes": (1.0, 1.0),
}
"""Size (u, v) of an image in units of the material's ``scale``; wood grain and boards run along u, stripes along v."""
SHADE_TOP = 1.25
"""Largest value of the shade factor."""
_BOARD = 8.0
"""Length of a board in units of its width."""


def pattern_tile(kind: str) -> np.ndarray:
    """Compute the image of a pattern.

    Args:
        kind: a key of `PERIODS`.

    Returns:
        (h, w, 3) uint8 with the channels mix, shade, 0; h and w are powers of two.

    Raises:
        KeyError: there is no such pattern; "plain" has none.
    """
    mix, shade = {
        "wood": _wood,
        "planks": _planks,
        "tiles": _tiles,
        "fabric": _fabric,
        "stripes": _stripes,
    }[kind]()
    shade = np.broadcast_to(shade, mix.shape)
    levels = np.stack(
        [
            np.clip(mix, 0.0, 1.0),
            np.clip(shade / SHADE_TOP, 0.0, 1.0),
            np.zeros_like(mix),
        ],
        axis=-1,
    )
    return np.round(255.0 * levels).astype(np.uint8)


def _grid(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates u, v (h, w) of pixel centres in 0..1."""
    return np.meshgrid(
        (np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height
    )


def _noise(
    seed: int, u: np.ndarray, v: np.ndarray, cells_u: int, cells_v: int
) -> np.ndarray:
    """Smooth value noise in 0..1 with period 1 in u and v, and the given number of cells in each direction."""
    # A fixed seed per pattern, since images are compared between machines.
    values = np.random.default_rng(seed).random((cells_v, cells_u))
    x = u * cells_u
    y = v * cells_v
    i = np.floor(x).astype(int)
    j = np.floor(y).astype(int)
    a = x - i
    b = y - j
    # Without a slope at the grid points, where one would see lines.
    a = a * a * (3.0 - 2.0 * a)
    b = b * b * (3.0 - 2.0 * b)
    i0 = i % cells_u
    i1 = (i + 1) % cells_u
    j0 = j % cells_v
    j1 = (j + 1) % cells_v
    low = values[j0, i0] * (1.0 - a) + values[j0, i1] * a
    high = values[j1, i0] * (1.0 - a) + values[j1, i1] * a
    return low * (1.0 - b) + high * b


def _grain(
    seed: int, u: np.ndarray, v: np.ndarray, length: float, width: float
) -> np.ndarray:
    """Wood grain along u on ``length`` x ``width`` units: stretched noise of two octaves, bent by slow noise."""
    bend = 0.6 * _noise(
        seed, u, v, max(1, round(0.25 * length)), max(1, round(0.5 * width))
    )
    ring = v + bend / width
    coarse = _noise(
        seed + 1, u, ring, max(1, round(0.22 * length)), max(1, round(3.4 * width))
    )
    fine = _noise(
        seed + 2, u, ring, max(1, round(0.9 * length)), max(1, round(18.0 * width))
    )
    return 0.45 + 0.75 * (coarse - 0.5) + 0.35 * (fine - 0.5)


def _wood() -> tuple[np.ndarray, np.ndarray]:
    u, v = _grid(256, 512)
    length, width = PERIODS["wood"]
    return _grain(1, u, v, length, width), np.ones(1)


def _planks() -> tuple[np.ndarray, np.ndarray]:
    """Boards of 1 x `_BOARD` units with one random tint each, separated by dark joints 0.04 units wide."""
    length, width = PERIODS["planks"]
    u, v = _grid(512, 1024)
    rng = np.random.default_rng(7)
    row = np.floor(v * width).astype(int)
    # Each row begins elsewhere, as on a real floor.
    shifted = u * length / _BOARD + rng.random(int(width))[row]
    count = round(length / _BOARD)
    board = np.floor(shifted).astype(int) % count
    tint = rng.random((int(width), count))[row, board]
    grain = _grain(8, (u + tint) % 1.0, v, length / 0.7, width / 0.7)
    across = v * width - row
    along = shifted - np.floor(shifted)
    edge = np.minimum(across, 1.0 - across)
    end = np.minimum(along, 1.0 - along) * _BOARD
    line = np.maximum(_seam(edge, 0.04, width / 1024), _seam(end, 0.04, length / 512))
    return 0.55 * tint + 0.45 * grain, 1.0 - 0.45 * line


def _seam(distance: np.ndarray, width: float, pixel: float) -> np.ndarray:
    """Coverage 0..1 of pixels by a line of ``width`` whose centre line is at ``distance`` from the pixels' centres.

    ``pixel`` is the size of a pixel; all lengths are in the same units.
    """
    return np.clip((0.5 * width - distance) / pixel + 0.5, 0.0, 1.0) * min(
        # A line thinner than a pixel is fainter instead of as wide as one.
        1.0,
        width / pixel,
    )


def _tiles() -> tuple[np.ndarray, np.ndarray]:
    """Square tiles of 1 unit separated by grout (mix 1); each tile has a random shade."""
    count = int(PERIODS["tiles"][0])
    u, v = _grid(512, 512)
    p = u * count
    q = v * count
    i = np.floor(p).astype(int)
    j = np.floor(q).astype(int)
    edge = np.minimum(np.minimum(p - i, 1.0 - p + i), np.minimum(q - j, 1.0 - q + j))
    shade = 0.95 + 0.08 * np.random.default_rng(5).random((count, count))[j, i]
    return _seam(edge, 0.026, count / 512), shade


def _fabric() -> tuple[np.ndarray, np.ndarray]:
    """Random threads 1/8 unit wide, with blotches of low-frequency noise."""
    u, v = _grid(256, 256)
    thread = np.random.default_rng(3).random((64, 64))[
        (v * 64).astype(int), (u * 64).astype(int)
    ]
    return 0.4 + 0.5 * (thread - 0.5) + 0.6 * (_noise(4, u, v, 12, 12) - 0.5), np.ones(1)


def _stripes() -> tuple[np.ndarray, np.ndarray]:
    """Two stripes of equal width, along v."""
    u, _ = _grid(64, 2)
    return (np.abs(u - 0.5) < 0.25).astype(float), np.ones(1)
