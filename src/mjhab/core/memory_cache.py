"""What a process remembers because it is costly to make: one limit for all of it, the least recently used goes first.

Maps, distance fields, compiled models and episodes can all be made again from their names. Every place that keeps such
values has a `MemoryCache` of its own; together they hold at most `memory_limit_mb`.
"""

from __future__ import annotations

import itertools
import math
import os
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple, TypeVar

from mjhab.core.typed.checks import check

LIMIT_VARIABLE = "MJHAB_CACHE_MB"
"""Environment variable with the limit [MB] of all caches of a process together."""
DEFAULT_LIMIT_MB = 512.0
"""Holds everything that the 105 built-in homes need in five environments at once (`benchmarks.soak`: about 250 MB)."""
ENTRY_BYTES = 500
"""What an entry takes besides its arrays: Python objects, keys."""
_ARRAY_DEPTH = 3
"""How deep `array_bytes` looks into objects: shared specs below are not counted for everyone who refers to them."""
_MB = 2**20
_Value = TypeVar("_Value")

_LOCK = threading.RLock()
_TURNS = itertools.count()
_CACHES: weakref.WeakSet[MemoryCache] = weakref.WeakSet()


class _Entry(NamedTuple):
    value: Any
    size: int
    turn: int


class MemoryCache:
    """Values of one kind, made when they are first asked for. Threads may share it.

    A value that was forgotten is made again: callers must not write into values, nor compare them by identity. What a
    cache holds goes with the cache. A copy and a pickled cache are empty.

    Args:
        kind: what the values are, for `memory_use`.
        most: most entries of this cache, 0 for as many as the limit of all caches allows.
        size: bytes that a value takes; its arrays (`array_bytes`) if not given.
    """

    def __init__(
        self, kind: str, most: int = 0, size: Callable[[Any], int] | None = None
    ) -> None:
        self.kind = kind
        self.most = most
        self._size = size or array_bytes
        self._entries: OrderedDict[Hashable, _Entry] = OrderedDict()
        self._bytes = 0
        with _LOCK:
            _CACHES.add(self)

    def __len__(self) -> int:
        return len(self._entries)

    def __contains__(self, key: Hashable) -> bool:
        return key in self._entries

    def __reduce__(self) -> tuple[Any, ...]:
        return MemoryCache, (self.kind, self.most, self._size)

    def get(self, key: Hashable, make: Callable[[], _Value]) -> _Value:
        """The value under ``key``; ``make`` gives it if it is not there. Two threads may make it at the same time."""
        with _LOCK:
            found = self._entries.pop(key, None)
            if found is not None:
                self._entries[key] = found._replace(turn=next(_TURNS))
                return found.value
        # Without the lock: making takes seconds, in which other threads go on.
        value = make()
        size = self._size(value) + ENTRY_BYTES
        with _LOCK:
            # Another thread may have been faster; its value is the one that others hold.
            if key not in self._entries:
                self._entries[key] = _Entry(value, size, next(_TURNS))
                self._bytes += size
                if self.most and len(self._entries) > self.most:
                    self.drop_oldest()
                _shrink()
        return value

    @property
    def bytes(self) -> int:
        """What its values take."""
        return self._bytes

    @property
    def oldest(self) -> float:
        """When its least recently used value was last asked for, as a running number; infinite without values."""
        return next(iter(self._entries.values())).turn if self._entries else math.inf

    def drop_oldest(self) -> None:
        """Forget the least recently used value."""
        _, entry = self._entries.popitem(last=False)
        self._bytes -= entry.size


def array_bytes(value: Any, depth: int = _ARRAY_DEPTH) -> int:
    """Bytes of the arrays, sparse matrices included, in a value, its items and its attributes."""
    own = getattr(value, "nbytes", None)
    if isinstance(own, int):
        return own
    if depth == 0 or isinstance(value, MemoryCache):
        return 0
    if isinstance(value, dict):
        parts = list(value.values())
    elif isinstance(value, list | tuple):
        parts = list(value)
    else:
        parts = list(getattr(value, "__dict__", {}).values())
    return sum(array_bytes(part, depth - 1) for part in parts)


def memory_limit_mb() -> float:
    """Limit [MB] of all caches of this process: `set_memory_limit`, else ``$MJHAB_CACHE_MB``, else 512.

    Raises:
        UsageError: the variable holds no number >= 0.
    """
    return _LIMIT.mb()


def set_memory_limit(mb: float) -> None:
    """Set the limit [MB] of this process and of those it starts from now on; 0 keeps nothing.

    Raises:
        UsageError: not a number >= 0.
    """
    _LIMIT.set(_checked(mb, "the limit of the cache in memory (--cache-mb)"))
    # Worker processes read it when they start.
    os.environ[LIMIT_VARIABLE] = str(mb)
    with _LOCK:
        _shrink()


def memory_use() -> dict[str, float]:
    """Megabytes that the caches of this process hold, by kind."""
    use: dict[str, float] = {}
    with _LOCK:
        for cache in _CACHES:
            use[cache.kind] = use.get(cache.kind, 0.0) + cache.bytes / _MB
    return {kind: round(use[kind], 2) for kind in sorted(use)}


class _Limit:
    """The limit of a process; the variable is read once, when it is first needed."""

    def __init__(self) -> None:
        self._mb: float | None = None

    def mb(self) -> float:
        if self._mb is None:
            given = os.environ.get(LIMIT_VARIABLE, "")
            self._mb = (
                _checked(given, f"${LIMIT_VARIABLE}") if given else DEFAULT_LIMIT_MB
            )
        return self._mb

    def set(self, mb: float) -> None:
        self._mb = mb


_LIMIT = _Limit()


def _checked(given: object, what: str) -> float:
    try:
        mb = float(str(given))
    except ValueError:
        mb = math.nan
    check(mb >= 0.0, what, given, "a number of megabytes >= 0")
    return mb


def _shrink() -> None:
    """Forget values until the rest fits. The caller holds the lock."""
    limit = memory_limit_mb() * _MB
    caches = list(_CACHES)
    total = sum(cache.bytes for cache in caches)
    while total > limit:
        # Over all kinds together: a limit for each would waste what one kind does not use.
        oldest = min(caches, key=lambda cache: cache.oldest)
        before = oldest.bytes
        oldest.drop_oldest()
        total += oldest.bytes - before
