"""Sources of packs from outside that fail: the error names the source."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import pytest

import mjhab
from mjhab.core.errors import UsageError
from mjhab.scenes.builtin.pack import builtin_pack
from mjhab.scenes.pack_source import PACK_SOURCES
from mjhab.scenes.spec import Pack
from tests.refusals import refused


def broken(request: Any) -> Any:
    raise KeyError("walls")


def refusing(request: Any) -> Any:
    raise UsageError("no walls.")


def of_homes(count: int) -> Callable[[Any], Pack]:
    """A function that opens the built-in pack with its first home ``count`` times."""
    pack = builtin_pack()
    return lambda request: dataclasses.replace(pack, homes=pack.homes[:1] * count)


@pytest.mark.parametrize(
    ("open_it", "told"),
    [
        (
            broken,
            (
                "asset pack 'mine' cannot open mine: its open raised KeyError: 'walls' (",
                "line",
            ),
        ),
        (refusing, "asset pack 'mine' cannot open mine: no walls."),
        (
            lambda request: None,
            ("asset pack 'mine' ", " must return a ", "Pack, got NoneType"),
        ),
        (of_homes(0), "asset pack mine: has no homes"),
        (of_homes(2), "asset pack mine: has 2 homes of the name 'builtin_m0_00'"),
    ],
)
def test_a_source_that_fails_is_named(
    open_it: Callable[[Any], Any], told: str | tuple[str, ...]
) -> None:
    mjhab.register_pack(mjhab.PackSource("mine", open_it))
    try:
        with refused(said=told):
            mjhab.open_pack("mine")
    finally:
        PACK_SOURCES.remove("mine")


def test_an_option_that_does_not_exist_is_told() -> None:
    source = mjhab.PackSource("mine", broken, options=frozenset({"articulated"}))
    with refused("option", "articulated", expected="articulate", where="pack 'mine'"):
        mjhab.register_pack(source)
