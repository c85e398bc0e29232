"""Find the device that a simulation on MuJoCo Warp runs on."""

from __future__ import annotations

import warp as wp

from mjhab.core.errors import UsageError, unknown_name


def open_device(name: str) -> wp.Device:
    """A Warp device by name: "cpu", "cuda:0", "cuda:1", ...; "" takes the first CUDA device.

    Raises:
        UsageError: there is no such device, or its driver cannot replay conditional graphs.
    """
    wp.init()
    if not name:
        if not wp.is_cuda_available():
            raise UsageError(
                "backend 'warp' found no CUDA device (is an NVIDIA driver installed?); for tests there is "
                "device='cpu', far slower than backend 'cpu'."
            )
        name = "cuda:0"
    names = [str(device) for device in wp.get_devices()]
    if name not in names:
        raise unknown_name("device", name, names)
    device = wp.get_device(name)
    if device.is_cuda and not wp.is_conditional_graph_supported():
        raise UsageError("backend 'warp' needs an NVIDIA driver for CUDA 12.4 or newer; update the driver.")
    return device
