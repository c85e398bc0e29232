"""Warp devices: open one by name, report its free memory, and order the work of Warp and torch on its streams."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
import warp as wp

from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.machine import install_extra
from mjhab.sim.warp.builds import announce_builds

LEAST_DRIVER = (12, 4)
"""Least CUDA version that the driver must support: the first with conditional nodes in graphs."""
_FULL = ("Failed to allocate", "out of memory", "not enough memory")
"""Parts of the messages with which Warp and torch report that memory is exhausted."""
_STREAMS: dict[tuple[int, int], wp.Stream] = {}
"""Warp handles of torch's streams by (device ordinal, stream); torch has a fixed set of streams per device."""


def open_device(name: str) -> wp.Device:
    """Return the Warp device of a name: "cpu", "cuda:0", "cuda:1", ...; "" is the first CUDA device.

    Raises:
        UsageError: there is no such device, its driver is too old, or Warp was built for an older CUDA.
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
    # Resets and the solver are conditional parts of captured graphs.
    if device.is_cuda and not wp.is_conditional_graph_supported():
        raise UsageError(
            f"backend 'warp' needs a Warp that was built with CUDA {_version(LEAST_DRIVER)} or newer; "
            f"{install_extra('gpu')} brings one."
        )
    return device


def _version(numbers: tuple[int, int]) -> str:
    return ".".join(map(str, numbers))


def free_mb(device: wp.Device) -> float:
    """Return the free memory of a CUDA device [MB]."""
    return device.free_memory / 2**20


@contextmanager
def room_for(num_worlds: int, device: wp.Device) -> Iterator[None]:
    """Context for work that allocates device memory: turns an out-of-memory error into a `UsageError`.

    Args:
        num_worlds: size of the batch, for the message.
        device: named in the message.

    Raises:
        UsageError: the device is out of memory; suggests half the number of worlds.
    """
    try:
        yield
    except RuntimeError as error:
        # Other errors of CUDA, such as "illegal memory access", are not caught.
        if not any(words in str(error) for words in _FULL):
            raise
        fewer = f"try {num_worlds // 2}" if num_worlds > 1 else "not even one does"
        raise UsageError(
            f"{num_worlds} worlds do not fit into the memory of {device}; {fewer} (num_envs, --worlds; "
            "`mjhab estimate` tells how many should fit)"
        ) from error


def torch_stream(device: wp.Device) -> wp.Stream:
    """Return torch's current stream of a CUDA device as a Warp stream.

    Work launched on it runs after what torch has queued so far and before what torch queues next.
    """
    stream = torch.cuda.current_stream(device.ordinal)
    key = (device.ordinal, stream.cuda_stream)
    # Each wrapping registers the stream with Warp once more.
    if key not in _STREAMS:
        _STREAMS[key] = wp.stream_from_torch(stream)
    return _STREAMS[key]


@contextmanager
def set_up(device: wp.Device) -> Iterator[None]:
    """Context for work on Warp's own stream: waits for the device before and after it, so that torch is in order."""
    # Work on two streams has no order of its own.
    wp.synchronize_device(device)
    with wp.ScopedDevice(device):
        yield
    wp.synchronize_device(device)
