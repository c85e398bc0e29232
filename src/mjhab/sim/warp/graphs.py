"""The one owner of captured graphs of device work, and of the memory that such work allocates."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import warp as wp

from mjhab.sim.warp.device import set_up, torch_stream


class Graphs:
    """Run device work by name; it is captured after its first run and replayed from then on.

    Work must launch the same kernels on the same arrays each time: no host copies, no replaced arrays. Whoever replaces
    an array or changes an engine option calls `forget`. On Warp's CPU device a replay spares the launches by Python,
    which cost more than the kernels of a few worlds.

    On CUDA a graph is launched on the stream that torch works on, whichever that is: tensors that share memory with
    the work are read and written in the order of the program. It is captured on a stream of its own, since that of
    torch, unless told otherwise, is one on which nothing can be captured.
    """

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self._graphs: dict[str, Any] = {}
        self._arena = _Arena(device)
        self._stream = wp.Stream(device) if device.is_cuda else None

    def run(self, name: str, work: Callable[[], None]) -> None:
        """Do the work that ``name`` stands for."""
        graph = self._graphs.get(name)
        if graph is None:
            self._graphs[name] = self._first_run(work)
        elif self.device.is_cuda:
            wp.capture_launch(graph, torch_stream(self.device))
        else:
            wp.capture_launch(graph)

    def _first_run(self, work: Callable[[], None]) -> Any:
        """Do the work and capture it. Waits for the device."""
        with set_up(self.device), wp.ScopedStream(self._stream), self._arena.lending():
            # This run loads kernels, which no capture may do, and counts as the run that was asked for; capturing
            # runs nothing.
            work()
            with self._arena.closed(), wp.ScopedCapture(self.device) as capture:
                work()
        return capture.graph

    def forget(self) -> None:
        """Drop all graphs; the next run of each captures it again."""
        self._graphs.clear()


class _Arena:
    """Memory that captured work takes and gives back, kept for as long as graphs may use it.

    The engine allocates within a step, and the body of a conditional graph must hold no allocation. All work runs on
    one stream, so that a block can serve one piece of work after the other.
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
        """While open, arrays that are made on the device get their memory here."""
        return self._allocating(self)

    @contextmanager
    def closed(self) -> Iterator[None]:
        """While open, only memory that was given back is lent on a GPU.

        What is allocated in a capture belongs to its graph alone, but a block lent here serves other graphs, too.
        """
        self._closed = self._device.is_cuda
        try:
            yield
        finally:
            self._closed = False

    def allocate(self, size_in_bytes: int) -> int:
        """Address of so many bytes.

        Raises:
            RuntimeError: captured work asks for a block that its first run did not need.
        """
        free = self._free.setdefault(size_in_bytes, [])
        if not free:
            if self._closed:
                raise RuntimeError(
                    f"work that is captured takes {size_in_bytes} bytes that its first run did not take"
                )
            with self._allocating(None):
                block = wp.empty(size_in_bytes, dtype=wp.uint8, device=self._device)  # type: ignore[arg-type]
            self._kept.append(block)
            free.append(int(block.ptr or 0))
        return free.pop()

    def deallocate(self, ptr: int, size_in_bytes: int) -> None:
        """Let a block of `allocate` be used again."""
        self._free[size_in_bytes].append(ptr)

    @contextmanager
    def _allocating(self, allocator: _Arena | None) -> Iterator[None]:
        """While open, the device takes memory from ``allocator``; None is its own."""
        device: Any = self._device
        if device.is_cuda:
            with wp.ScopedAllocator(device, allocator):
                yield
            return
        # Warp offers this for CUDA only.
        before = device.default_allocator
        device.default_allocator = allocator or self._plain
        try:
            yield
        finally:
            device.default_allocator = before
