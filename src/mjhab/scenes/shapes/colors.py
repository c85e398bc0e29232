"""sRGB, in which colours are written, and linear light, in which they are mixed (IEC 61966-2-1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike


def srgb_to_linear(color: ArrayLike) -> np.ndarray:
    """Convert sRGB values in 0..1 (any shape) to linear light."""
    c = np.asarray(color, np.float64)
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(light: ArrayLike) -> np.ndarray:
    """Convert linear light (any shape), clipped to 0..1, to sRGB values in 0..1."""
    c = np.clip(np.asarray(light, np.float64), 0.0, 1.0)
    return np.where(c <= 0.0031308, 12.92 * c, 1.055 * c ** (1 / 2.4) - 0.055)
