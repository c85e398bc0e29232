"""Elementary functions of arrays, whose last bits are those of the C library on every processor.

With AVX-512 NumPy takes other code for float64 `arctan2`, `power`, `exp`, `log`, `tan` and the inverse functions of
angles, with other last bits than on a processor without; `sin` and `cos` are the same. Products of two vectors, and
norms of one without ``axis``, are those of BLAS, whose last bits differ as well. What decides where an episode begins
takes these functions, or `math` for single numbers; ``tests/bits/test_source.py`` asks for it.
"""

from __future__ import annotations

import math

import numpy as np


def arccos(values: np.ndarray) -> np.ndarray:
    """Angles (...) [rad] of cosines (...) within -1 to 1.

    >>> arccos(np.array([1.0, 0.0]))
    array([0.        , 1.57079633])
    """
    return np.vectorize(math.acos, otypes=[np.float64])(values)


def arctan2(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Angles (...) [rad] of directions (x, y), each (...).

    >>> arctan2(np.array([0.0, 1.0]), np.array([1.0, 1.0]))
    array([0.        , 0.78539816])
    """
    return np.vectorize(math.atan2, otypes=[np.float64])(y, x)


def tan(angles: np.ndarray) -> np.ndarray:
    """Tangents (...) of angles (...) [rad].

    >>> tan(np.array([0.0, 0.5]))
    array([0.        , 0.54630249])
    """
    return np.vectorize(math.tan, otypes=[np.float64])(angles)
