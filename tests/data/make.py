"""Shards for the tests."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from mjhab.data.images import ImageFormat
from mjhab.data.recorder import Recorder
from mjhab.data.shard import ShardWriter
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import RandomPolicy
from mjhab.rollout.records import EpisodeRecord
from tests.data.fake_world import FakeEnv

POLICY = {"name": "random"}


def record(
    path: Path, episodes: Iterable[int] = range(4), env: FakeEnv | None = None, seed: int = 0, **options: Any
) -> tuple[list[EpisodeRecord], Recorder]:
    """Roll out episodes of a fake env into a shard; returns their records and the recorder."""
    env = env or FakeEnv()
    max_steps = options.pop("max_steps", None)
    with ShardWriter(path) as writer:
        recorder = Recorder(writer, env, POLICY, **options)
        records = rollout(env, RandomPolicy(0), list(episodes), seed, [recorder], max_steps)
    return records, recorder


def chains_and_picks(folder: Path) -> Path:
    """Three chains and two Picks in a folder, with images."""
    record(folder / "chains.h5", range(3), FakeEnv(images=True), images=ImageFormat())
    record(folder / "picks.h5", range(2), FakeEnv(subtask="pick", images=True), images=ImageFormat())
    return folder
