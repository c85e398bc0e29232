"""A running environment and a shard, which several tests look at."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import mjhab

STEPS = 12


@pytest.fixture(scope="session")
def shard(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two short episodes of Pick in which the robot moves at random."""
    out = tmp_path_factory.mktemp("shard")
    mjhab.generate(
        "random",
        out=out,
        subtask="pick",
        episodes=2,
        worlds=2,
        horizon=STEPS,
        reward_mode="dense",
        threads=1,
    )
    return out


@pytest.fixture(scope="session")
def env() -> Iterator[Any]:
    """One world of Pick, reset to its first episode; for reading only."""
    made = mjhab.make(subtask="pick", autoreset="disabled", threads=1)
    made.reset(seed=0, options={"episode": [0]})
    yield made
    made.close()
