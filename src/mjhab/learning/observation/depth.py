"""Depth as the images of a learned policy show it."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from mjhab.core.arrays import Array, device_of, namespace

MILLIMETRES_PER_METRE = 1000.0
BYTE = 255


def _nearness_table() -> np.ndarray:
    # Depth has 32,768 values at most: a look-up costs less than a tanh, and gives the same bits on every device.
    metres = np.arange(np.iinfo(np.int16).max + 1) / MILLIMETRES_PER_METRE
    return np.rint(BYTE * (1.0 - np.tanh(metres))).astype(np.uint8)


_NEARNESS = _nearness_table()


def nearness(depth: Array) -> Array:
    """Map int16 depth [mm] to uint8 nearness 255 (1 - tanh(depth / 1 m)), 255 at the lens (mshab/agents/bc).

    Args:
        depth: of any shape, numpy or torch; not negative.
    """
    if isinstance(depth, np.ndarray):
        return _NEARNESS[depth]
    xp = namespace(depth)
    table = _table_on(xp, device_of(depth))
    return table[xp.astype(depth, xp.int64)]


@lru_cache(maxsize=8)
def _table_on(xp: Any, device: Any) -> Array:
    return xp.asarray(_NEARNESS, device=device)


def pooled(images: Array, factor: int) -> Array:
    """Images (..., H, W) uint8 reduced to means of ``factor`` x ``factor`` pixels, numpy."""
    if factor == 1:
        return images
    *rows, height, width = images.shape
    blocks = images.reshape(*rows, height // factor, factor, width // factor, factor)
    # Rounded and not cut: cutting would darken each image by half a value.
    return np.rint(blocks.mean(axis=(-3, -1))).astype(np.uint8)
