"""Farthest-point sampling."""

from __future__ import annotations

import numpy as np


def farthest_points(features: np.ndarray, count: int) -> np.ndarray:
    """Select points that are far apart, by greedy farthest-point sampling.

    Args:
        features: (N, D) points, compared by Euclidean distance.
        count: largest number of points.

    Returns:
        (min(N, count),) int64 row indices: row 0, then repeatedly the row farthest from all selected ones.
    """
    apart = np.full(len(features), np.inf)
    rows: list[int] = []
    row = 0
    for _ in range(min(count, len(features))):
        rows.append(row)
        apart = np.minimum(apart, np.linalg.norm(features - features[row], axis=1))
        # Below every distance, so that a point is not taken twice even where others coincide with it.
        apart[row] = -1.0
        row = int(np.argmax(apart))
    return np.array(rows, np.int64)
