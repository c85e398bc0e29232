"""Largest memory of the process and of the GPU while a computation runs."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any


def gpu_used_mb(device: Any) -> float | None:
    """Memory of a device of Warp's that is in use, by anybody [MB]; None if there is none, or it is no GPU."""
    if device is None or not device.is_cuda:
        return None
    return (device.total_memory - device.free_memory) / 2**20


class MemorySampler:
    """A thread that reads memory every ``interval`` [s] between enter and exit, and once at either end.

    Args:
        rss_mb: memory of the process [MB].
        device_mb: memory of the device in use [MB], None where there is none.

    ``peak_rss_mb``, ``peak_device_mb``: the largest values; ``samples``: how many were taken.
    """

    def __init__(
        self,
        rss_mb: Callable[[], float],
        device_mb: Callable[[], float | None],
        interval: float = 0.05,
    ) -> None:
        self._rss = rss_mb
        self._device = device_mb
        self._interval = interval
        self.peak_rss_mb = 0.0
        self.peak_device_mb: float | None = None
        self.samples = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(
            target=self._run, name="memory sampler", daemon=True
        )

    def __enter__(self) -> MemorySampler:
        self._sample()
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._stop.set()
        # Joined before the last sample, so that no two threads write the peaks.
        self._thread.join()
        self._sample()

    def _run(self) -> None:
        # A wait on the event and no sleep: leaving must not take another interval.
        while not self._stop.wait(self._interval):
            self._sample()

    def _sample(self) -> None:
        self.samples += 1
        self.peak_rss_mb = max(self.peak_rss_mb, round(self._rss(), 1))
        device = self._device()
        if device is not None:
            self.peak_device_mb = max(self.peak_device_mb or 0.0, round(device, 1))
