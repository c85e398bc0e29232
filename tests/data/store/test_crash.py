"""A kill at any moment loses at most the episode in flight; a full disk loses nothing; two writers never meet."""

from __future__ import annotations

import errno
import os
import random
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import h5py
import pytest

from mjhab.core.errors import UsageError
from mjhab.core.files.locking import is_written, lock_path
from mjhab.data.select.sets import select
from mjhab.data.store import hdf5
from mjhab.data.store.checking import check, repair
from mjhab.data.store.episode_data import EpisodeData
from mjhab.data.store.episode_files import INDEX, EpisodeFiles, part_folder
from mjhab.data.store.hdf5 import dataset, group
from mjhab.data.store.older.journal import journal_path
from mjhab.data.store.packing import pack
from mjhab.data.store.places import episodes
from mjhab.data.store.reading import open_shard
from mjhab.data.store.schema import DamagedError
from mjhab.data.store.shard import ShardWriter
from mjhab.data.store.storage import StorageError
from tests.data.make import numbered, one_episode, record
from tests.refusals import refused

KILLED = Path(__file__).parent / "killed"
"""A shard of one episode, and the journal of the second one, whose writer (mjhab 0.1) was killed before it applied it.
"""


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> EpisodeData:
    """An episode that tests number anew."""
    return one_episode(tmp_path_factory.mktemp("template"))


class Killed(BaseException):
    """Stands for the end of the process: nothing after it is executed but what Python cannot avoid."""


def die_at(monkeypatch: pytest.MonkeyPatch, when: int) -> Callable[[], int]:
    """Let the ``when``-th change of a file end the writer, before or after it; returns a counter."""
    count = 0

    def wrap(owner: Any, name: str) -> None:
        real = getattr(owner, name)

        def call(*args: Any, **options: Any) -> Any:
            nonlocal count
            count += 1
            if count > when:
                raise Killed
            if count == when:
                if when % 2:
                    real(*args, **options)
                raise Killed
            return real(*args, **options)

        monkeypatch.setattr(owner, name, call)

    for owner, name in (
        (os, "fsync"),
        (os, "replace"),
        (os, "unlink"),
        (os, "rmdir"),
        (os, "write"),
        (os, "mkdir"),
    ):
        wrap(owner, name)
    return lambda: count


def test_a_kill_between_any_two_steps_loses_at_most_the_last_episode(
    tmp_path: Path, template: EpisodeData, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcomes = set()
    for when in range(1, 100):
        path = tmp_path / str(when) / "a.h5"
        with ShardWriter(path) as writer:
            writer.append(numbered(template, 0))
            writer.append(numbered(template, 1))
        writer = ShardWriter(path)
        with monkeypatch.context() as patch:
            done = die_at(patch, when)
            try:
                writer.append(numbered(template, 2))
                writer.close()
                finished = True
            except Killed:
                finished = False
        writer._release()
        seen = len(list(episodes(path)))
        assert len(select(path).matched) == len(select(path.parent).matched) == seen
        report = check(path)
        assert report.clean and report.ok == seen and seen in (2, 3)
        assert seen == 3 or not finished
        with ShardWriter(path) as again:
            assert len(again.names) == seen
            if seen == 2:
                again.append(numbered(template, 2))
            again.append(numbered(template, 3))
        assert check(path).ok == 4 and not part_folder(path).exists()
        assert not lock_path(path).exists()
        outcomes.add((seen, finished))
        if finished:
            assert done() < when
            break
    assert outcomes == {(2, False), (3, False), (3, True)} and when > 8


def test_a_kill_while_packing_loses_nothing(
    tmp_path: Path, template: EpisodeData, monkeypatch: pytest.MonkeyPatch
) -> None:
    for when in range(1, 100):
        folder = tmp_path / str(when)
        files = EpisodeFiles(folder / "episodes")
        for index in range(4):
            files.append(numbered(template, index))
        with monkeypatch.context() as patch:
            done = die_at(patch, when)
            try:
                pack(folder, 0.05)
                finished = True
            except Killed:
                finished = False
        assert len(select(folder).matched) == check(folder).ok == 4
        assert check(folder).clean
        if finished:
            assert done() < when
            break
        if files.folder.is_dir():
            pack(folder, 0.05)
        assert len(list(folder.glob("shard_*.h5"))) == 2 and not files.folder.is_dir()
        assert check(folder).ok == 4
    assert 10 < when < 99


def test_real_kills_at_random_moments(tmp_path: Path, template: EpisodeData) -> None:
    path = tmp_path / "a.h5"
    dice = random.Random(0)
    rounds = int(os.environ.get("MJHAB_KILLS", "25"))
    count = 0
    for _ in range(rounds):
        read, write = os.pipe()
        child = os.fork()
        if child == 0:
            _write_until_killed(path, template, write)
        os.close(write)
        assert os.read(read, 1) == b"."
        # On a busy machine some milliseconds may hold no episode at all: up to two are waited for.
        waited = [os.read(read, 1) for _ in range(dice.randrange(3))]
        time.sleep(dice.uniform(0.0, 0.05))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        told = count + len(waited) + len(os.read(read, 1 << 16))
        os.close(read)
        assert not is_written(path)
        count = len(list(episodes(path))) if part_folder(path).is_dir() else 0
        # The child speaks after its episode is on the disk: one more may be, never one less.
        assert count in (told, told + 1)
    report = check(path)
    assert report.clean and report.ok == count > 10
    assert len(select(path).matched) == count
    with ShardWriter(path) as writer:
        assert sorted(writer.names) == [
            template.run.episode_name(0, i) for i in range(count)
        ]
    assert [p.name for p in tmp_path.iterdir()] == ["a.h5"]


def _write_until_killed(path: Path, template: EpisodeData, pipe: int) -> NoReturn:
    try:
        writer = ShardWriter(path)
        index = len(writer.names)
        os.write(pipe, b".")
        while True:
            writer.append(numbered(template, index))
            os.write(pipe, b"e")
            index += 1
    finally:
        os._exit(1)


def full(*_: Any) -> Any:
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("fails", [1, 2, 3, 20])
def test_a_full_disk_stops_cleanly_and_the_next_run_goes_on(
    tmp_path: Path, template: EpisodeData, monkeypatch: pytest.MonkeyPatch, fails: int
) -> None:
    path = tmp_path / "a.h5"
    with ShardWriter(path) as writer:
        writer.append(numbered(template, 0))
        with monkeypatch.context() as patch:
            patch.setattr(hdf5.io, "FileIO", small_disk(fails))
            with pytest.raises(
                StorageError,
                match=r"disk is full.*same command again.*finished before is safe",
            ):
                writer.append(numbered(template, 1))
        with refused(where="a.h5", said="has been closed"):
            writer.append(numbered(template, 2))
    assert check(path).clean and check(path).ok == 1
    with ShardWriter(path) as again:
        again.append(numbered(template, 1))
        again.append(numbered(template, 2))
        with monkeypatch.context() as patch:
            patch.setattr(hdf5.io, "FileIO", small_disk(fails))
            with pytest.raises(StorageError, match="disk is full"):
                again.close()
    assert check(path).ok == 3 and not path.exists()
    with ShardWriter(path):
        pass
    assert check(path).ok == 3 and [p.name for p in tmp_path.iterdir()] == ["a.h5"]


def small_disk(writes: int) -> type[hdf5.io.FileIO]:
    """Files of a disk that is full from the write of that number on."""

    class File(hdf5.io.FileIO):
        left = writes

        def write(self, data: Any) -> int:
            File.left -= 1
            return super().write(data) if File.left > 0 else full()

    return File


def test_a_full_disk_when_a_shard_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = ShardWriter(tmp_path / "a.h5")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StorageError, match="disk is full"):
        writer.close()
    assert list(tmp_path.iterdir()) == []


def test_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(
        StorageError, match=r"cannot write .*a.h5: (Not a directory|File exists)"
    ):
        ShardWriter(tmp_path / "file" / "a.h5")


def test_two_writers(tmp_path: Path, template: EpisodeData) -> None:
    path = tmp_path / "a.h5"
    with ShardWriter(path) as writer:
        with refused(where=path, said=f"being written by process {os.getpid()} on "):
            ShardWriter(path)
        child = os.fork()
        if child == 0:
            try:
                ShardWriter(path)
            except UsageError:
                os._exit(7)
            os._exit(1)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
        writer.append(numbered(template, 0))
        assert is_written(path) and len(list(episodes(path))) == 1
        writer.append(numbered(template, 1))
        assert len(list(episodes(path))) == 2 and not check(path).unfinished
        with refused(said="already; nothing was written"):
            writer.append(numbered(template, 1))
    with ShardWriter(path) as writer:
        assert len(writer.names) == 2
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.h5"]


def test_what_a_killed_writer_of_an_older_version_left_is_finished(
    tmp_path: Path,
) -> None:
    for finish in (repair, lambda path: ShardWriter(path).close()):
        folder = Path(shutil.copytree(KILLED, tmp_path / "killed"))
        path = folder / "killed.h5"
        with pytest.raises(DamagedError, match=r"did not finish.*mjhab data repair"):
            open_shard(path)
        assert check(path).unfinished == [path]
        finish(path)
        assert not journal_path(path).exists() and check(path).ok == 2
        shutil.rmtree(folder)


def test_a_torn_journal_of_an_older_version_is_dropped(tmp_path: Path) -> None:
    path = Path(shutil.copytree(KILLED, tmp_path / "killed")) / "killed.h5"
    os.truncate(journal_path(path), 3000)
    done = repair(path)
    assert done.finished and done.kept == check(path).ok == 1
    assert not journal_path(path).exists()


def test_a_journal_of_another_file_is_not_applied(
    tmp_path: Path, template: EpisodeData
) -> None:
    path = tmp_path / "killed.h5"
    with ShardWriter(path) as writer:
        writer.append(numbered(template, 1))
    shutil.copy(journal_path(KILLED / "killed.h5"), journal_path(path))
    before = path.read_bytes()
    for act in (ShardWriter, repair):
        with pytest.raises(
            DamagedError, match=r"does not belong to killed.h5.*delete the journal"
        ):
            act(path)
    assert path.read_bytes() == before and not lock_path(path).exists()


def test_plain_h5py_reads_a_shard(tmp_path: Path) -> None:
    records, _ = record(tmp_path / "a.h5", range(2))
    with h5py.File(tmp_path / "a.h5", "r") as file:
        assert file.attrs["format"] == b"mjhab-episodes"
        names = sorted(group(file, "episodes"))
        assert len(names) == 2
        episode = group(file, f"episodes/{names[0]}")
        assert (
            dataset(episode, "actions").shape
            == (records[0].steps, 13)
            == (episode.attrs["steps"], 13)
        )
        assert str(dataset(episode, "signals/checks").attrs["columns"]).startswith(
            "b'is_grasped,"
        )


def test_the_table_may_be_torn_old_or_absent(
    tmp_path: Path, template: EpisodeData
) -> None:
    """The files are the truth: what the table does not know, or knows otherwise, is read from them."""
    files = EpisodeFiles(tmp_path / "set" / "episodes")
    for index in range(3):
        files.append(numbered(template, index))
    table = files.folder / INDEX
    whole = table.read_bytes()
    wanted = select(tmp_path)
    assert len(wanted.matched) == 3
    for content in (None, b"", whole[:-20], b"\xff\n{}\n[]\nnull\n" + whole, whole[:100]):
        if content is None:
            table.unlink()
        else:
            table.write_bytes(content)
        assert select(tmp_path) == wanted
        assert select(tmp_path) == wanted
        lines = table.read_bytes().splitlines()
        assert len(lines) >= 4 and {*whole.splitlines()} <= {*lines}
    name = sorted(files.names)[1]
    files.path_of(name).unlink()
    assert [one for _, one in select(tmp_path).matched] == sorted(files.names - {name})
    files.path_of(sorted(files.names)[0]).write_bytes(b"no episode")
    with pytest.raises(DamagedError, match="not an HDF5 file"):
        select(tmp_path)


def test_a_set_that_may_only_be_read_needs_no_table(
    tmp_path: Path, template: EpisodeData, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = EpisodeFiles(tmp_path / "episodes")
    files.append(numbered(template, 0))
    (files.folder / INDEX).unlink()
    monkeypatch.setattr("mjhab.data.store.episode_files.write_atomic", full)
    assert len(select(tmp_path).matched) == 1 and not (files.folder / INDEX).exists()
