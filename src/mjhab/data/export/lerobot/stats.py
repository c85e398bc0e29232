"""The statistics that LeRobot stores with a data set, per episode and in total."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

Stats = dict[str, np.ndarray]
"""min, max, mean, std, count and quantiles of one feature; count is (1,)."""
QUANTILES: dict[str, float] = {
    "q01": 0.01,
    "q10": 0.10,
    "q50": 0.50,
    "q90": 0.90,
    "q99": 0.99,
}
"""Quantiles of LeRobot v3.0 (lerobot/datasets/compute_stats.py)."""
# The smallest sample in LeRobot's own statistics (compute_stats.py, estimate_num_samples).
_FRAMES = 100
"""Approximate number of images per episode that the statistics use."""


def vector_stats(values: np.ndarray) -> Stats:
    """Statistics per column of a feature (N, D) or (N,): arrays (D,) or (1,)."""
    # In float32 the variance of a long column with a large mean loses its digits.
    return _stats(values.reshape(len(values), -1).astype(np.float64), len(values))


def map_stats(values: np.ndarray) -> Stats:
    """Statistics of maps (N, H, W), such as depth, over all their pixels: arrays (1,)."""
    return _stats(values.reshape(-1, 1).astype(np.float64), len(values))


def image_stats(images: np.ndarray) -> Stats:
    """Statistics of images (n, H, W, 3) uint8 per channel, in 0..1: arrays (3, 1, 1)."""
    stats = _stats(images.reshape(-1, 3) / 255.0, len(images))
    return {
        name: value if name == "count" else value.reshape(3, 1, 1)
        for name, value in stats.items()
    }


def sampled(count: int) -> frozenset[int]:
    """Indices of the images, out of ``count``, that the statistics use."""
    return frozenset(
        # Evenly spread: the first frames alone would show the start pose only.
        np.linspace(0, count - 1, min(count, _FRAMES)).round().astype(int).tolist()
    )


def aggregate(parts: Sequence[Mapping[str, Stats]]) -> dict[str, Stats]:
    """Statistics of a data set from those of its episodes; quantiles are weighted means, as in LeRobot."""
    out: dict[str, Stats] = {}
    for key in parts[0]:
        each = [part[key] for part in parts]
        count = np.sum([stats["count"] for stats in each], axis=0)
        weights = [stats["count"].item() / count.item() for stats in each]

        def mean(
            # Bound as defaults, since a closure would see the values of the last key.
            name: str,
            each: list[Stats] = each,
            weights: list[float] = weights,
        ) -> np.ndarray:
            return np.sum(
                [w * stats[name] for w, stats in zip(weights, each, strict=True)], axis=0
            )

        centre = mean("mean")
        spread = [
            # Variance within episodes, and that between their means.
            w * (s["std"] ** 2 + (s["mean"] - centre) ** 2)
            for w, s in zip(weights, each, strict=True)
        ]
        out[key] = {
            "min": np.min([stats["min"] for stats in each], axis=0),
            "max": np.max([stats["max"] for stats in each], axis=0),
            "mean": centre,
            "std": np.sqrt(np.sum(spread, axis=0)),
            "count": count,
            **{name: mean(name) for name in QUANTILES},
        }
    return out


def _stats(rows: np.ndarray, count: int) -> Stats:
    return {
        "min": rows.min(axis=0),
        "max": rows.max(axis=0),
        "mean": rows.mean(axis=0),
        "std": rows.std(axis=0),
        "count": np.array([count]),
        **quantiles_of(rows),
    }


def quantiles_of(rows: np.ndarray) -> Stats:
    """Quantiles per column of rows (N, D)."""
    found = np.quantile(rows, list(QUANTILES.values()), axis=0)
    return dict(zip(QUANTILES, found, strict=True))
