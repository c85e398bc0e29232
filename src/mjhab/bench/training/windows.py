"""``mjhab bench windows``: how many training windows a core reads from a data set, first and later passes."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from mjhab.bench.specs import WindowsSpec
from mjhab.core.errors import UsageError
from mjhab.data.select.sets import nothing_passes
from mjhab.data.store.places import episodes


def measure_windows(spec: WindowsSpec) -> dict[str, Any]:
    """Read all windows of a data set in random order, batch by batch: once to decode, then until time is up.

    Returns:
        "windows", "bytes_per_window", and for "first" and "later" passes "per_s" (wall) and "per_cpu_s": the second one
        does not depend on what else the machine does.

    Raises:
        UsageError: no episode, or one without the images.
    """
    import torch

    from mjhab.data.select.dataset import SeededSampler, Window, WindowDataset

    first = next(episodes(spec.places), None)
    if first is None:
        raise nothing_passes()
    images = spec.images or tuple("/".join(image) for image in first.images)
    if not images:
        raise UsageError(
            "the episodes have no images: record them with `mjhab generate --images depth`, or draw them with "
            "`mjhab replay --render`."
        )
    data = WindowDataset(
        spec.places, Window(history=spec.history, chunk=spec.chunk, images=images)
    )
    torch.set_num_threads(1)
    sampler = SeededSampler(len(data), spec.seed)
    passes = {"first": _read(data, sampler, spec.batch, 0.0)}
    passes["later"] = _read(data, sampler, spec.batch, spec.seconds)
    window = sum(value.nbytes for value in data[[0]].values())
    return {
        "windows": len(data),
        "images": list(images),
        "bytes_per_window": window,
        **passes,
    }


def _read(data: Any, sampler: Any, batch: int, seconds: float) -> dict[str, float]:
    """Read whole passes for at least ``seconds``, one if 0."""
    wall = time.perf_counter()
    cpu = time.process_time()
    count = 0
    while not count or time.perf_counter() - wall < seconds:
        order = np.fromiter(sampler, np.int64, len(data))
        for at in range(0, len(order), batch):
            count += len(data[order[at : at + batch]]["step"])
    return {
        "per_s": round(count / (time.perf_counter() - wall), 1),
        "per_cpu_s": round(count / (time.process_time() - cpu), 1),
    }
