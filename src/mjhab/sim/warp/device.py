"""The device of a simulation on MuJoCo Warp: found by name, the memory it has left, and the order of work on it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
import warp as wp

from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.machine import install_extra
from mjhab.sim.warp.builds import announce_builds

LEAST_DRIVER = (12, 4)
"""Version of CUDA that the driver must be good for: the first whose graphs can hold conditions."""
_FULL = ("Failed to allocate", "out of memory", "not enough memory")
_STREAMS: dict[tuple[int, int], wp.Stream] = {}
"""Streams of torch, which has a fixed set of them per device, as Warp knows them."""


def open_device(name: str) -> wp.Device:
    """A Warp device by name: "cpu", "cuda:0", "cuda:1", ...; "" takes the first CUDA device.

    Raises:
        UsageError: there is no such device, or its driver is too old.
    """
    wp.init()
    announce_builds()
    driver = wp.get_cuda_driver_version()
    if name != "cpu" and driver is not None and driver < LEAST_DRIVER:
        raise UsageError(
            f"backend 'warp' needs an NVIDIA driver for CUDA {_version(LEAST_DRIVER)} or newer, this one is for "
            f"{_version(driver)}; update the driver to 550 or newer."
        )
    if not name and not wp.is_cuda_available():
        raise UsageError(
            "backend 'warp' found no CUDA device (is an NVIDIA driver installed?); for tests there is "
            "device='cpu', far slower than backend 'cpu'."
        )
    names = [str(device) for device in wp.get_devices()]
    if name and name not in names:
        raise unknown_name("device", name, names)
    device = wp.get_device(name or "cuda:0")
    if device.is_cuda and not wp.is_conditional_graph_supported():
        raise UsageError(
            f"backend 'warp' needs a Warp that was built with CUDA {_version(LEAST_DRIVER)} or newer; "
            f"{install_extra('gpu')} brings one."
        )
    return device


def _version(numbers: tuple[int, int]) -> str:
    return ".".join(map(str, numbers))


def free_mb(device: wp.Device) -> float:
    """Free memory of a CUDA device [MB]."""
    return device.free_memory / 2**20


@contextmanager
def room_for(num_worlds: int, device: wp.Device) -> Iterator[None]:
    """For work that takes memory of a device: where there is not enough, say so in one line.

    Raises:
        UsageError: the device is out of memory; names a smaller number of worlds.
    """
    try:
        yield
    except RuntimeError as error:
        # Of Warp ("Failed to allocate ...") and of torch ("CUDA out of memory ..."), but no "illegal memory access".
        if not any(words in str(error) for words in _FULL):
            raise
        fewer = f"try {num_worlds // 2}" if num_worlds > 1 else "not even one does"
        raise UsageError(
            f"{num_worlds} worlds do not fit into the memory of {device}; {fewer} (num_envs, --worlds; "
            "`mjhab doctor --estimate` tells how many should fit)"
        ) from error


def torch_stream(device: wp.Device) -> wp.Stream:
    """The stream of a CUDA device that torch works on at present: what is launched there comes after what torch was
    given before, and before what torch is given next."""
    stream = torch.cuda.current_stream(device.ordinal)
    key = (device.ordinal, stream.cuda_stream)
    if key not in _STREAMS:
        _STREAMS[key] = wp.stream_from_torch(stream)
    return _STREAMS[key]


@contextmanager
def set_up(device: wp.Device) -> Iterator[None]:
    """For work on Warp's own stream: torch's is done before it begins, and it is done before torch goes on. Waits."""
    wp.synchronize_device(device)
    with wp.ScopedDevice(device):
        yield
    wp.synchronize_device(device)
