"""Kernels for numba: compiled at the first call, which is announced, and kept on disk.

Imported only by modules that hold kernels, because numba takes a while to load.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

from numba import config, njit
from numba.core import event

from mjhab.core.files.cache import cache_dir
from mjhab.core.files.code_digest import code_digest
from mjhab.core.progress import say

Decorator = Callable[[Callable[..., Any]], Any]


class _Announcer(event.Listener):
    """Tells on stderr, once per process, that kernels are compiled."""

    def __init__(self) -> None:
        self._said = False

    def on_start(self, event: event.Event) -> None:
        if not self._said:
            self._said = True
            say(
                "mjhab: compiling kernels for the processor. About a minute the first time, "
                "later they are on disk (`mjhab warmup` does it beforehand)."
            )

    def on_end(self, event: event.Event) -> None:
        pass


@cache
def _announce() -> None:
    """From now on, say when this process compiles kernels; those found on disk are not compiled."""
    event.register("numba:compile", _Announcer())


def compiler(*modules: str, **options: Any) -> Decorator:
    """A decorator that makes functions kernels.

    Args:
        modules: names below ``mjhab`` of all modules whose code or constants go into the kernels. Numba renews a
            compiled function when its own file changes, but not for a helper or a constant of another file.
        options: what `numba.njit` takes besides ``cache``, ``nogil`` and ``error_model``.
    """
    _announce()
    # numba looks at the time of one file alone; kernels depend on others that they call.
    digest = code_digest("core.kernels.jit", *modules).hex()[:8]
    settings: dict[str, Any] = {
        # Threads run kernels at the same time; none of them touches Python objects.
        "nogil": True,
        "cache": True,
        # Division by zero gives infinity, as in the array functions; a check before each would also cost time.
        "error_model": "numpy",
    } | options

    def decorate(function: Callable[..., Any]) -> Any:
        # The name is part of the cache file's name.
        function.__qualname__ = f"{function.__qualname__}_{digest}"
        try:
            return njit(**settings)(function)
        except RuntimeError:
            # Neither beside the code nor in the user's folder can anything be written.
            config.CACHE_DIR = str(cache_dir() / "numba")  # pyright: ignore[reportAttributeAccessIssue]
            return njit(**settings)(function)

    return decorate
