"""The one owner of captured graphs of device work, and of the memory that such work allocates."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import warp as wp


class Graphs:
    """Run device work by name; it is captured after its first run and replayed from then on.

    Work must launch the same kernels on the same arrays each time: no host copies, no replaced arrays. Whoever replaces
    an array or changes an engine option calls `forget`. On Warp's CPU device a replay spares the launches by Python,
    which cost more than the kernels of a few worlds.
    """

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self._graphs: dict[str, Any] = {}
        self._arena = _Arena(device)

    def run(self, name: str, work: Callable[[], None]) -> None:
        """Do the work that ``name`` stands for."""
        graph = self._graphs.get(name)
        if graph is not None:
            wp.capture_launch(graph)
            return
        with self._arena.lending():
            # The first run loads kernels, which no capture may do, and counts as the run that was asked for; capturing
            # runs nothing.
            work()
            with wp.ScopedCapture(self.device) as capture:
                work()
        self._graphs[name] = capture.graph

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

    def lending(self) -> AbstractContextManager[None]:
        """While open, arrays that are made on the device get their memory here."""
        return self._allocating(self)

    def allocate(self, size_in_bytes: int) -> int:
        """Address of so many bytes."""
        free = self._free.setdefault(size_in_bytes, [])
        if not free:
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
        before, device.default_allocator = device.default_allocator, allocator or self._plain
        try:
            yield
        finally:
            device.default_allocator = before
