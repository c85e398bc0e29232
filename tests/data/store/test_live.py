"""Reading a shard while somebody records into it: whole episodes only."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from mjhab.data.store.checking import check
from mjhab.data.store.episode_data import EpisodeData
from mjhab.data.store.places import episodes, shards_in
from mjhab.data.store.reading import open_shard
from mjhab.data.store.shard import ShardWriter
from tests.data.make import numbered, one_episode

READER = """
import sys
from pathlib import Path
from mjhab.data.store.damage import episode_problems
from mjhab.data.store.places import entries, episodes

path, enough, opened, seen = Path(sys.argv[1]), int(sys.argv[2]), 0, 0
while seen < enough:
    found = [episode for episode in episodes(path) if not episode_problems(episode)]
    assert len(list(entries(path))) >= len(found) >= seen
    seen, opened = len(found), opened + 1
print(opened)
"""


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> EpisodeData:
    """An episode that tests number anew."""
    return one_episode(tmp_path_factory.mktemp("template"))


def test_who_reads_meets_whole_episodes_only(
    tmp_path: Path, template: EpisodeData
) -> None:
    path = tmp_path / "a.h5"
    count = 60
    writer = ShardWriter(path)
    writer.append(numbered(template, 0))
    readers = [
        subprocess.Popen(
            [sys.executable, "-c", READER, str(path), str(count)],
            stdout=subprocess.PIPE,
            text=True,
        )
        for _ in range(2)
    ]
    for index in range(1, count):
        writer.append(numbered(template, index))
    opened = [int(reader.communicate(timeout=120)[0]) for reader in readers]
    assert [reader.returncode for reader in readers] == [0, 0] and min(opened) > 0
    writer.close()
    assert check(path).ok == count


def test_who_opened_it_before_reads_on(tmp_path: Path, template: EpisodeData) -> None:
    path = tmp_path / "a.h5"
    with ShardWriter(path) as writer:
        for index in range(3):
            writer.append(numbered(template, index))
    with open_shard(path) as shard:
        first = shard.episode(shard.names[0])
        actions = first.array("actions")
        with ShardWriter(path) as writer:
            writer.append(numbered(template, 3))
        assert len(shard) == 3
        np.testing.assert_array_equal(first.array("actions"), actions)
        assert first.run.config == {"a": 1}
    assert len(list(episodes(path))) == 4


def test_a_shard_held_open_by_h5py_is_added_to(
    tmp_path: Path, template: EpisodeData
) -> None:
    path = tmp_path / "a.h5"
    with ShardWriter(path) as writer:
        writer.append(numbered(template, 0))
    with h5py.File(path, "r", locking=False), ShardWriter(path) as writer:
        writer.append(numbered(template, 1))
    assert check(path).ok == 2


def test_a_folder_that_goes_while_it_is_looked_through_is_passed_over(
    tmp_path: Path,
) -> None:
    for name in ("first.h5", "gone/second.h5", "kept/third.h5", "kept/.fourth.h5"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    found = shards_in(tmp_path)
    assert next(found).name == "first.h5"
    shutil.rmtree(tmp_path / "gone")
    assert [path.name for path in found] == ["third.h5"]
