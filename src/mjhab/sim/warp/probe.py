"""Functions of Warp that need no simulation: list CUDA devices, wait for a device."""

from __future__ import annotations

import warp as wp

wp.config.log_level = wp.LOG_WARNING


def cuda_devices() -> list[str]:
    """Return the names of the CUDA devices, e.g. ["cuda:0"]."""
    wp.init()
    return [str(device) for device in wp.get_cuda_devices()]


def synchronize(device: wp.Device) -> None:
    """Block until a device has finished all queued work."""
    wp.synchronize_device(device)
