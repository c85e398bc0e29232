"""Shards for the tests."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py

from mjhab.data.record.recorder import Recorder
from mjhab.data.store.episode_data import EpisodeData, RunInfo, episode_digest
from mjhab.data.store.hdf5 import group, read_arrays
from mjhab.data.store.images import ImageFormat
from mjhab.data.store.reading import open_shard
from mjhab.data.store.shard import ShardWriter
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import RandomPolicy
from mjhab.rollout.records import EpisodeRecord
from tests.data.fake_world import FakeEnv

POLICY = {"name": "random"}


def record(
    path: Path,
    episodes: Iterable[int] = range(4),
    env: FakeEnv | None = None,
    seed: int = 0,
    **options: Any,
) -> tuple[list[EpisodeRecord], Recorder]:
    """Roll out episodes of a fake env into a shard; returns their records and the recorder."""
    world: Any = env or FakeEnv()
    max_steps = options.pop("max_steps", None)
    with ShardWriter(path) as writer:
        recorder = Recorder(writer, world, POLICY, **options)
        records = rollout(
            world, RandomPolicy(0), list(episodes), seed, [recorder], max_steps
        )
    return records, recorder


def record_pictures(
    path: Path, episodes: Iterable[int] = range(4), subtask: str = "pick"
) -> None:
    """Record episodes with images of a fake env: of a subtask, or of the whole task for ""."""
    record(path, episodes, FakeEnv(subtask=subtask, images=True), images=ImageFormat())


def one_episode(folder: Path) -> EpisodeData:
    """An episode for tests to number anew (`numbered`) and append."""
    path = folder / "a.h5"
    record(path, range(1))
    with open_shard(path) as shard:
        episode = next(iter(shard))
        arrays = {name: episode.array(name) for name in episode.paths if name != "record"}
        return EpisodeData(episode.record, RunInfo({"a": 1}), "m", "success", arrays)


def numbered(data: EpisodeData, index: int) -> EpisodeData:
    """The same episode under another index."""
    return replace(data, record=replace(data.record, index=index))


def make_older(path: Path) -> None:
    """Turn a shard into one of schema 1, without what came later."""
    with h5py.File(path, "r+") as file:
        file.attrs["schema"] = 1
        for name in group(file, "episodes"):
            episode = group(file, f"episodes/{name}")
            del (
                episode["actions_intended"],
                episode["actor"],
                episode.attrs["schema"],
                episode.attrs["actors"],
            )
            episode.attrs["digest"] = episode_digest(read_arrays(episode))


def chains_and_picks(folder: Path) -> Path:
    """Three chains and two Picks in a folder, with images."""
    record_pictures(folder / "chains.h5", range(3), "")
    record_pictures(folder / "picks.h5", range(2))
    return folder
