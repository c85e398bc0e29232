"""A few of many, as different from each other as possible."""

from __future__ import annotations

import numpy as np

Array = np.ndarray


def farthest_points(features: Array, count: int) -> Array:
    """Rows of points that lie far apart.

    Args:
        features: (N, D) points; their Euclidean distance says how different two of them are.
        count: largest number of rows.

    Returns:
        Row 0, then always the row farthest from all those before it.
    """
    apart = np.full(len(features), np.inf)
    rows: list[int] = []
    row = 0
    for _ in range(min(count, len(features))):
        rows.append(row)
        apart = np.minimum(apart, np.linalg.norm(features - features[row], axis=1))
        apart[row] = -1.0
        row = int(np.argmax(apart))
    return np.array(rows, np.int64)
