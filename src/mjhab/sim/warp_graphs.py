"""The one owner of captured CUDA graphs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import warp as wp


class Graphs:
    """Run device work by name; on a CUDA device it is captured after its first run and replayed from then on.

    Work must launch the same kernels on the same arrays each time: no host copies, no replaced arrays. Whoever replaces
    an array or changes an engine option calls `forget`. On the CPU device the work is simply called.
    """

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self._graphs: dict[str, Any] = {}

    def run(self, name: str, work: Callable[[], None]) -> None:
        """Do the work that ``name`` stands for."""
        if not self.device.is_cuda:
            work()
            return
        graph = self._graphs.get(name)
        if graph is not None:
            wp.capture_launch(graph)
            return
        # The first run loads kernels, which no capture may do, and counts as the run that was asked for; capturing
        # runs nothing.
        work()
        with wp.ScopedCapture(self.device) as capture:
            work()
        self._graphs[name] = capture.graph

    def forget(self) -> None:
        """Drop all graphs; the next run of each captures it again."""
        self._graphs.clear()
