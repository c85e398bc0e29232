"""Captured graphs of device work, and the memory that captured work allocates."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import warp as wp

from mjhab.sim.warp.device import set_up, torch_stream


class Graphs:
    """Runs functions of device work by name: captures each into a graph on its first run, replays the graph afterwards.

    A function must launch the same kernels on the same arrays each time, without copies to the host. After replacing an
    array or changing an engine option, call `forget`. On Warp's CPU device a replay saves the kernel launches from
    Python, which cost more than the kernels themselves for a few worlds.

    On CUDA a graph is launched on torch's current stream, so that torch operations on shared tensors keep their order
    with it. It is captured on a separate stream, because torch's default stream does not allow capture.

    Args:
        device: the Warp device that the functions work on.
    """

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self._graphs: dict[str, Any] = {}
        self._arena = _Arena(device)
        self._stream = wp.Stream(device) if device.is_cuda else None

    def run(self, name: str, work: Callable[[], None]) -> None:
        """Run ``work``: capture it on the first call with ``name``, replay the graph of ``name`` on later calls."""
        graph = self._graphs.get(name)
        if graph is None:
            self._graphs[name] = self._first_run(work)
        elif self.device.is_cuda:
            wp.capture_launch(graph, torch_stream(self.device))
        else:
            wp.capture_launch(graph)

    def _first_run(self, work: Callable[[], None]) -> Any:
        """Run the work once, then capture it; return the graph. Waits for the device."""
        # A stream of its own, since the default stream cannot be captured.
        with set_up(self.device), wp.ScopedStream(self._stream), self._arena.lending():
            # The first call loads kernels, which is not allowed in a capture, and is the requested run: a capture
            # executes nothing.
            work()
            with self._arena.closed(), wp.ScopedCapture(self.device) as capture:
                work()
        return capture.graph

    def forget(self) -> None:
        """Drop all graphs; the next `run` of each name captures it again."""
        self._graphs.clear()


class _Arena:
    """Allocator for captured work that never frees its blocks, because graphs may use them later.

    The engine allocates temporary arrays within a step, but the body of a conditional graph must not allocate. All work
    runs on one stream, so that one block can be reused by one graph after the other.
    """

    deallocate_requires_context_guard = False
    memory_kind = None

    def __init__(self, device: wp.Device) -> None:
        self._device = device
        self._plain = None if device.is_cuda else device.default_allocator
        self._free: dict[int, list[int]] = {}
        self._kept: list[wp.array] = []
        self._closed = False

    def lending(self) -> AbstractContextManager[None]:
        """Context in which new arrays on the device get their memory from this arena."""
        return self._allocating(self)

    @contextmanager
    def closed(self) -> Iterator[None]:
        """Context in which a GPU arena only hands out free blocks and allocates no new ones.

        Memory allocated during a capture belongs to that graph alone, but blocks of the arena are shared by graphs.
        """
        self._closed = self._device.is_cuda
        try:
            yield
        finally:
            self._closed = False

    def allocate(self, size_in_bytes: int) -> int:
        """Return the address of a block of ``size_in_bytes`` (Warp's allocator protocol).

        Raises:
            RuntimeError: a capture needs a block that the first run of the work did not allocate.
        """
        # By exact size: work that repeats asks for the same sizes.
        free = self._free.setdefault(size_in_bytes, [])
        if not free:
            if self._closed:
                raise RuntimeError(
                    f"work that is captured takes {size_in_bytes} bytes that its first run did not take"
                )
            # The device's own allocator, or this one would call itself.
            with self._allocating(None):
                block = wp.empty(size_in_bytes, dtype=wp.uint8, device=self._device)  # type: ignore[arg-type]
            # The array owns the memory: without a reference it would be freed.
            self._kept.append(block)
            free.append(int(block.ptr or 0))
        return free.pop()

    def deallocate(self, ptr: int, size_in_bytes: int) -> None:
        """Return a block of `allocate` to the free blocks."""
        self._free[size_in_bytes].append(ptr)

    @contextmanager
    def _allocating(self, allocator: _Arena | None) -> Iterator[None]:
        """Context in which the device allocates from ``allocator``; None is its own allocator."""
        device: Any = self._device
        if device.is_cuda:
            with wp.ScopedAllocator(device, allocator):
                yield
            return
        # wp.ScopedAllocator works for CUDA devices only.
        before = device.default_allocator
        device.default_allocator = allocator or self._plain
        try:
            yield
        finally:
            device.default_allocator = before
