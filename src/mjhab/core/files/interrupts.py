"""Ctrl-C and SIGTERM: running writes and updates are completed, and finished results are kept."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_BOTH = (signal.SIGTERM, signal.SIGINT)


@contextmanager
def stop_signals() -> Iterator[Any]:
    """Within this context SIGTERM and Ctrl-C only make the yielded function return True; a second Ctrl-C interrupts."""
    seen: list[int] = []

    def note(number: int, frame: Any) -> None:
        # Whoever presses it twice does not want to wait.
        if seen and number == signal.SIGINT:
            raise KeyboardInterrupt
        seen.append(number)

    before = {number: signal.signal(number, note) for number in _BOTH}
    try:
        yield lambda: bool(seen)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def sigterm_interrupts() -> Iterator[None]:
    """Within this context, the first SIGTERM has the effect of Ctrl-C; later ones are ignored, so writes complete."""
    seen: list[int] = []

    def interrupt(number: int, frame: Any) -> None:
        seen.append(number)
        if len(seen) == 1:
            raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def held_interrupts() -> Iterator[None]:
    """Delay Ctrl-C and SIGTERM that come within this context until it ends; their own handlers take them then.

    For what must be whole: a checkpoint that is written after an update holds all of it.

    Outside of the main thread, which alone receives signals, this does nothing.
    """
    # Python refuses to set handlers elsewhere.
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[tuple[int, Any]] = []

    def note(number: int, frame: Any) -> None:
        came.append((number, frame))

    before = {number: signal.signal(number, note) for number in _BOTH}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    # One is enough: the second would interrupt the clean-up after the first.
    for number, _ in came[:1]:
        signal.raise_signal(number)


@contextmanager
def kernel_interrupts() -> Iterator[None]:
    """Within this context Ctrl-C is a KeyboardInterrupt also where it comes while a compiled kernel runs.

    numba then makes a SystemError of it, several where kernels call kernels, and nobody takes these for the wish to
    stop.
    """
    try:
        yield
    except SystemError as error:
        first: BaseException | None = error
        while isinstance(first, SystemError):
            first = first.__cause__
        if isinstance(first, KeyboardInterrupt):
            raise KeyboardInterrupt from error
        raise
