"""Generation on a local Ray cluster. Run by ``make test-ray``, which installs Ray in an environment of its own."""

from __future__ import annotations

import importlib
import os
import random
import signal
import time
from pathlib import Path
from typing import Any

import pytest

from mjhab.core.errors import UsageError
from mjhab.data.record.generation import generate
from mjhab.data.record.job import Standing
from mjhab.data.record.ray_workers import LOCAL, RayPool
from mjhab.data.store.checking import check
from tests.data.record.worker_pools import KEEP, InlinePool, job, kept


def workers(pool: Any) -> list[int]:
    """Process ids of its actors that are alive."""
    ray = importlib.import_module("ray")
    found = []
    for actor in list(pool._actors.values()):
        try:
            found.append(
                ray.get(actor.__ray_call__.remote(lambda _: os.getpid()), timeout=60)
            )
        except ray.exceptions.RayError:
            continue
    return found


@pytest.mark.parametrize("seed", range(2))
def test_a_worker_killed_in_the_middle_loses_and_doubles_nothing(
    tmp_path: Path, seed: int
) -> None:
    generate(job(tmp_path / "reference", KEEP, worlds=1, per_target=25), InlinePool())
    dice = random.Random(seed)
    killed = list[int]()
    out = tmp_path / "ray"
    pool = RayPool(LOCAL)

    def kill(now: Standing) -> None:
        if len(killed) < 2 and now.written >= 5 * (1 + len(killed)):
            killed.append(
                dice.choice([pid for pid in workers(pool) if pid not in killed])
            )
            os.kill(killed[-1], signal.SIGKILL)

    done = generate(job(out, KEEP, per_target=25, workers=2), pool, kill)
    assert len(killed) == 2 and done.complete and done.written == done.kept == 25
    assert kept(out) == kept(tmp_path / "reference") and check(out).clean


def test_a_run_stops_in_the_middle_of_an_episode(tmp_path: Path) -> None:
    told: list[Standing] = []
    pool: Any = RayPool(LOCAL)
    done = generate(
        job(tmp_path, episodes=100_000, workers=2),
        pool,
        told.append,
        lambda: len(told) > 5,
    )
    begun = time.monotonic()
    assert (
        not done.complete
        and len(kept(tmp_path)) == done.kept >= 3
        and check(tmp_path).clean
    )
    again = generate(job(tmp_path, episodes=done.kept + 5), RayPool(LOCAL), resume=True)
    assert (
        again.complete
        and list(kept(tmp_path)) == list(range(done.kept + 5))
        and time.monotonic() - begun < 60
    )


def test_a_cluster_that_is_not_there() -> None:
    with pytest.raises(UsageError, match="no Ray cluster can be reached"):
        RayPool("127.0.0.1:1")
