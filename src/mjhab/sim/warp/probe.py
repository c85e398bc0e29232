"""Questions to Warp that need no simulation: which CUDA devices there are, whether one has finished."""

from __future__ import annotations

import warp as wp

wp.config.log_level = wp.LOG_WARNING


def cuda_devices() -> list[str]:
    """Names of the CUDA devices, e.g. ["cuda:0"]."""
    wp.init()
    return [str(device) for device in wp.get_cuda_devices()]


def synchronize(device: wp.Device) -> None:
    """Wait until a device has done all work it was given."""
    wp.synchronize_device(device)
