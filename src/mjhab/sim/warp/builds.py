"""Progress messages on stderr while Warp compiles kernels; the first compilation takes minutes."""

from __future__ import annotations

import functools
import re
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import warp as wp
from warp._src import build

LINE_EVERY = 15.0
"""Least time [s] between two messages if stderr is no terminal; on a terminal each message replaces the last."""


class BuildProgress:
    """Counts compiled modules and prints a message before each.

    Args:
        clock: returns a monotonic time [s].

    Attributes:
        count: modules compiled so far.
        seconds: time spent compiling [s].
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self.count = 0
        self.seconds = 0.0
        # So that the first module is told at once.
        self._last_line = -LINE_EVERY

    def watch(
        self, compiler: Callable[..., Any], source: Callable[..., str]
    ) -> Callable[..., Any]:
        """Return ``compiler`` wrapped so that each call counts a module and prints a message.

        ``source`` returns the path of the compiled file from the arguments of ``compiler``.
        """

        @functools.wraps(compiler)
        def announced(*args: Any, **kwargs: Any) -> Any:
            begun = self._clock()
            self.count += 1
            self._say(source(*args))
            try:
                return compiler(*args, **kwargs)
            finally:
                self.seconds += self._clock() - begun
                # Only a terminal can take a line back.
                if sys.stderr.isatty():
                    print("\r\033[K", end="", file=sys.stderr, flush=True)

        return announced

    def _say(self, path: str) -> None:
        # wp_mujoco_warp._src.solver_1a2b3c4.cu -> mujoco_warp._src.solver
        module = re.sub(r"^wp_|_[0-9a-f]{7,}$", "", Path(path).stem)
        text = (
            f"mjhab: compiling kernels of backend warp: module {self.count} ({module}), {self.seconds:.0f} s so far. "
            "Some minutes the first time, later they are on disk."
        )
        if sys.stderr.isatty():
            print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)
        elif self._clock() - self._last_line >= LINE_EVERY:
            self._last_line = self._clock()
            print(text, file=sys.stderr, flush=True)


@functools.cache
def announce_builds() -> BuildProgress:
    """Print a message before each kernel module that this process compiles from now on.

    Returns:
        The counter of compiled modules, the same object for every call.
    """
    # Warp's own lines would stand between ours.
    wp.config.log_level = wp.LOG_WARNING
    progress = BuildProgress()
    # Warp itself reports a module only after compiling it. Cached modules do not call these two functions.
    build.build_cpu = progress.watch(
        build.build_cpu, lambda binary, source, *_: str(source)
    )
    build.build_cuda = progress.watch(build.build_cuda, lambda source, *_: str(source))
    return progress
