"""Options of environments whose values have other types, as a file may hold them."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from mjhab.config.env import EnvConfig
from mjhab.core.errors import UsageError

VALUES: tuple[Any, ...] = (
    None,
    [],
    {},
    3,
    "x",
    [1],
    float("nan"),
    10**30,
    True,
    [None],
    {"a": None},
)


@pytest.mark.parametrize(
    "name", [option.name for option in dataclasses.fields(EnvConfig)]
)
def test_any_value_is_taken_or_refused(name: str) -> None:
    default = getattr(EnvConfig(subtask="pick"), name)
    for value in VALUES:
        try:
            config = EnvConfig(**{"subtask": "pick", name: value})
        except UsageError:
            continue
        if isinstance(default, str):
            assert isinstance(getattr(config, name), str | None)
