"""How many training windows a core reads from a data set, first and later passes: ``python -m benchmarks.windows``."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.command import run_command
from mjhab.cli.output import Listing, report
from mjhab.core.errors import UsageError
from mjhab.data.select.sets import nothing_passes
from mjhab.data.store.places import episodes


@dataclass(frozen=True)
class WindowsSpec:
    """Measure how many training windows per second a core reads from recorded episodes with images.

    `mjhab generate --subtask close --episodes 20 --images depth --out runs/close`

    `python -m benchmarks.windows runs/close --history 2`
    """

    places: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Shards (*.h5) or folders of shards."""
    history: int = 2
    """Observations in a window."""
    chunk: int = 1
    """Actions in a window."""
    images: tuple[str, ...] = ()
    """Which images, as CAMERA/depth; all that the first episode has if absent."""
    batch: int = 64
    """Windows in a batch."""
    seconds: float = 5.0
    """Duration of the measurement of later passes [s]."""
    seed: int = 0
    """Seed of the order of the windows."""
    json: bool = False
    """Print one line of JSON instead of a table."""


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
    # Windows per core are asked for.
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


def bench_windows(spec: WindowsSpec) -> int:
    """Print windows per second; returns 0.

    Raises:
        UsageError: the duration is out of range.
    """
    if not 0 < spec.seconds <= 3600:
        raise UsageError(
            f"--seconds must be above 0 and at most 3600, got {spec.seconds}."
        )
    found = measure_windows(spec)
    rows = [
        (name, f"{found[key]['per_s']:,.0f}", f"{found[key]['per_cpu_s']:,.0f}")
        for name, key in (
            ("first pass, which decodes", "first"),
            ("later passes", "later"),
        )
    ]
    title = f"{found['windows']:,} windows of {found['bytes_per_window']:,} bytes: {', '.join(found['images'])}"
    columns = ("pass", "windows/s", "windows per second of CPU")
    report(spec.json, found, Listing(title, columns, rows))
    return 0


def main(words: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command(
        "windows",
        WindowsSpec,
        bench_windows,
        words,
        {"history": 1, "chunk": 1, "batch": 1},
    )


if __name__ == "__main__":
    sys.exit(main())
