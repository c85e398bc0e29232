"""Reading a shard while somebody appends to it: whole episodes, and no end of the process inside HDF5."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from mjhab.core.files.locking import quiet
from mjhab.data.store.checking import check
from mjhab.data.store.damage import problems_in
from mjhab.data.store.episode_data import EpisodeData
from mjhab.data.store.reading import open_shard
from mjhab.data.store.shard import ShardWriter
from tests.data.make import numbered, one_episode

READER = """
import sys
from pathlib import Path
from mjhab.data.store.damage import problems_in
from mjhab.data.store.reading import open_shard

path, enough, opened, seen = Path(sys.argv[1]), int(sys.argv[2]), 0, 0
while seen < enough:
    with open_shard(path) as shard:
        assert len(shard) >= seen
        seen, opened = len(shard), opened + 1
        assert not problems_in(shard, shard.names[0]) and not problems_in(shard, shard.names[-1])
        assert not any(problem for name in shard.names[:: max(1, seen // 3)] for problem in problems_in(shard, name))
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
    count = 120
    with ShardWriter(path) as writer:
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
    opened = [int(reader.communicate(timeout=60)[0]) for reader in readers]
    assert [reader.returncode for reader in readers] == [0, 0] and min(opened) > 3
    assert check(path).ok == count


def test_who_opened_it_before_reads_on(tmp_path: Path, template: EpisodeData) -> None:
    path = tmp_path / "a.h5"
    with ShardWriter(path) as writer:
        for index in range(3):
            writer.append(numbered(template, index))
        with open_shard(path) as shard, open_shard(path) as other:
            first = shard.episode(shard.names[0])
            actions = first.array("actions")
            for index in range(3, 200):
                writer.append(numbered(template, index))
            assert len(shard) == 3 and not any(
                problems_in(shard, name) for name in shard.names
            )
            np.testing.assert_array_equal(first.array("actions"), actions)
            assert first.run.config == {"a": 1}
            with ShardWriter(tmp_path / "b.h5") as copy:
                copy.adopt(other, other.names)
    report = check([path, tmp_path / "b.h5"])
    assert report.episodes == report.ok == 203 and len(report.doubled) == 3


def test_a_shard_held_open_by_h5py_is_appended_to(
    tmp_path: Path, template: EpisodeData
) -> None:
    path = tmp_path / "a.h5"
    with ShardWriter(path) as writer:
        writer.append(numbered(template, 0))
        with h5py.File(path, "r"):
            writer.append(numbered(template, 1))
    assert check(path).ok == 2


def test_without_locks_on_folders_it_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr("mjhab.core.files.locking.fcntl.flock", refuse)
    with quiet(tmp_path / "a.h5", change=True):
        pass
