"""One limit for everything that a process remembers."""

from __future__ import annotations

import copy
import os
import pickle
from collections.abc import Iterator

import numpy as np
import pytest

from mjhab.core import memory_cache
from mjhab.core.memory_cache import (
    LIMIT_VARIABLE,
    MemoryCache,
    array_bytes,
    memory_limit_mb,
    memory_use,
    set_memory_limit,
)
from tests.refusals import refused

MB = 2**20


@pytest.fixture
def limit(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Give the process its limit back after a test that changes it."""
    monkeypatch.setattr(memory_cache, "_CACHES", type(memory_cache._CACHES)())
    before = memory_limit_mb()
    variable = os.environ.get(LIMIT_VARIABLE)
    yield
    set_memory_limit(before)
    os.environ.pop(LIMIT_VARIABLE)
    if variable is not None:
        os.environ[LIMIT_VARIABLE] = variable


def megabyte() -> np.ndarray:
    return np.zeros(MB, np.uint8)


def test_a_value_is_made_once(limit: None):
    cache = MemoryCache("test")
    made: list[int] = []
    for _ in range(3):
        assert cache.get("a", lambda: made.append(1) or len(made)) == 1
    assert made == [1] and len(cache) == 1


def test_the_limit_holds_for_all_caches_and_the_least_recently_used_goes_first(
    limit: None,
):
    set_memory_limit(3.5)
    first = MemoryCache("maps")
    second = MemoryCache("models")
    first.get("old", megabyte)
    second.get("used", megabyte)
    first.get("new", megabyte)
    first.get("old", megabyte)
    second.get("newest", megabyte)
    assert (
        "used" not in second and "old" in first and "new" in first and "newest" in second
    )
    assert memory_use() == {"maps": 2.0, "models": 1.0}


def test_a_lower_limit_forgets_at_once_and_zero_keeps_nothing(limit: None):
    cache = MemoryCache("test")
    for k in range(4):
        cache.get(k, megabyte)
    set_memory_limit(2.5)
    assert [k in cache for k in range(4)] == [False, False, True, True]
    set_memory_limit(0)
    assert len(cache.get("big", megabyte)) == MB and len(cache) == 0


def test_a_cache_has_its_own_bound_and_takes_its_values_along(limit: None):
    cache = MemoryCache("test", most=2)
    for k in range(3):
        cache.get(k, megabyte)
    assert 0 not in cache and len(cache) == 2 and memory_use() == {"test": 2.0}
    del cache
    assert memory_use() == {}


def test_copies_are_empty(limit: None):
    cache = MemoryCache("test", most=2)
    cache.get("a", megabyte)
    for other in (copy.deepcopy(cache), pickle.loads(pickle.dumps(cache))):
        assert len(other) == 0 and other.most == 2


def test_bytes_of_arrays_in_a_value():
    class Map:
        def __init__(self) -> None:
            self.grid = np.zeros(100)
            self.parts = (np.zeros(10), {"a": np.zeros(1)})
            self.inner = MemoryCache("test")

    assert array_bytes(Map()) == 8 * 111
    assert array_bytes("nothing") == 0


@pytest.mark.parametrize("given", ["-1", "nan", "much", "1 GB"])
def test_a_limit_that_is_no_size_is_refused(given: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(memory_cache, "_LIMIT", memory_cache._Limit())
    monkeypatch.setenv(LIMIT_VARIABLE, given)
    with refused("$MJHAB_CACHE_MB"):
        memory_limit_mb()
