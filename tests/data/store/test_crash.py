"""A kill at any moment loses at most the episode in flight; a full disk loses nothing; two writers never meet."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import random
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import h5py
import numpy as np
import pytest

from mjhab.core.errors import UsageError
from mjhab.core.files.locking import is_written, lock_path
from mjhab.data.store import journal as jn
from mjhab.data.store.checking import check, repair
from mjhab.data.store.episode_data import EpisodeData
from mjhab.data.store.hdf5 import dataset, group
from mjhab.data.store.journal import Overlay, journal_path
from mjhab.data.store.reading import open_shard
from mjhab.data.store.schema import DamagedError
from mjhab.data.store.shard import ShardWriter, StorageError
from tests.data.make import numbered, one_episode, record


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> EpisodeData:
    """An episode that tests number anew."""
    return one_episode(tmp_path_factory.mktemp("template"))


class Killed(BaseException):
    """Stands for the end of the process: nothing after it is executed but what Python cannot avoid."""


def die_at(monkeypatch: pytest.MonkeyPatch, when: int) -> Callable[[], int]:
    """Let the ``when``-th change of a file end the writer, after half of it if it is a write; returns a counter."""
    count = 0

    def wrap(name: str) -> None:
        real = getattr(os, name)

        def call(*args: Any) -> Any:
            nonlocal count
            count += 1
            if count > when:
                raise Killed
            if count == when:
                if name == "pwrite":
                    real(args[0], bytes(args[1])[: len(args[1]) // 2], args[2])
                raise Killed
            return real(*args)

        monkeypatch.setattr(jn.os, name, call)

    for name in ("pwrite", "fsync", "ftruncate", "truncate", "unlink"):
        wrap(name)
    return lambda: count


def test_a_kill_between_any_two_steps_loses_at_most_the_last_episode(
    tmp_path: Path, template: EpisodeData, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcomes = set()
    for when in range(1, 100):
        path = tmp_path / f"{when}.h5"
        with ShardWriter(path) as writer:
            writer.append(numbered(template, 0))
            writer.append(numbered(template, 1))
        writer = ShardWriter(path)
        with monkeypatch.context() as patch:
            done = die_at(patch, when)
            try:
                writer.append(numbered(template, 2))
                finished = True
            except Killed:
                finished = False
        writer.close()
        with open_shard(path) as shard:
            seen = len(shard)
        report = check(path)
        assert (
            report.clean
            and report.ok == seen
            and seen in (2, 3)
            and (seen == 3 or not finished)
        )
        with ShardWriter(path) as again:
            assert len(again.names) == seen
            if seen == 2:
                again.append(numbered(template, 2))
            again.append(numbered(template, 3))
        assert (
            check(path).ok == 4
            and not journal_path(path).exists()
            and not lock_path(path).exists()
        )
        outcomes.add((seen, finished))
        if finished:
            assert done() < when
            break
    assert outcomes == {(2, False), (3, False), (3, True)} and when > 8


def test_a_kill_during_recovery_is_recovered_from(
    tmp_path: Path, template: EpisodeData, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.h5"
    with ShardWriter(path) as writer:
        writer.append(numbered(template, 0))
    whole = None
    for when in range(1, 40):
        writer = ShardWriter(path)
        before = path.read_bytes()
        with monkeypatch.context() as patch:
            die_at(patch, when)
            with pytest.raises(Killed):
                writer.append(numbered(template, 1))
        writer.close()
        if jn.read_journal(path) is not None:
            whole = path.read_bytes(), journal_path(path).read_bytes()
            break
        journal_path(path).unlink(missing_ok=True)
        path.write_bytes(before)
    assert whole is not None
    for when in range(1, 40):
        path.write_bytes(whole[0])
        journal_path(path).write_bytes(whole[1])
        with monkeypatch.context() as patch:
            done = die_at(patch, when)
            with contextlib.suppress(Killed):
                jn.recover(path)
        with ShardWriter(path) as writer:
            assert len(writer.names) == 2
        assert check(path).clean
        if done() < when:
            break
    assert 3 < when < 39


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
        with open_shard(path) as shard:
            count = len(shard)
        # The child speaks after its episode is on the disk: one more may be, never one less.
        assert count in (told, told + 1)
    report = check(path)
    assert report.clean and report.ok == count > 10
    with ShardWriter(path) as writer:
        assert sorted(writer.names) == [
            template.run.episode_name(0, i) for i in range(count)
        ]


def _write_until_killed(path: Path, template: EpisodeData, pipe: int) -> NoReturn:
    try:
        with ShardWriter(path) as writer:
            index = len(writer.names)
            os.write(pipe, b".")
            while True:
                writer.append(numbered(template, index))
                os.write(pipe, b"e")
                index += 1
    finally:
        os._exit(1)


@pytest.mark.parametrize("fails", range(1, 4))
def test_a_full_disk_stops_cleanly_and_the_next_run_goes_on(
    tmp_path: Path, template: EpisodeData, monkeypatch: pytest.MonkeyPatch, fails: int
) -> None:
    path = tmp_path / "a.h5"
    with ShardWriter(path) as writer:
        writer.append(numbered(template, 0))
        count = 0
        real = os.pwrite

        def full(*args: Any) -> int:
            nonlocal count
            count += 1
            if count == fails:
                real(args[0], bytes(args[1])[:10], args[2])
                raise OSError(errno.ENOSPC, "No space left on device")
            return real(*args)

        with monkeypatch.context() as patch:
            patch.setattr(jn.os, "pwrite", full)
            with pytest.raises(
                StorageError,
                match=r"disk is full.*same command again.*finished before is safe",
            ):
                writer.append(numbered(template, 1))
        with pytest.raises(UsageError, match="has been closed"):
            writer.append(numbered(template, 2))
    assert check(path).clean
    with ShardWriter(path) as again:
        if not again.has(template.run, 0, 1):
            again.append(numbered(template, 1))
        again.append(numbered(template, 2))
    assert check(path).ok == 3


def test_a_full_disk_when_a_shard_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StorageError, match="disk is full"):
        ShardWriter(tmp_path / "a.h5")
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
        with pytest.raises(
            UsageError, match=rf"being written by process {os.getpid()} on .*another file"
        ):
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
        assert is_written(path)
        with open_shard(path) as shard:
            assert len(shard) == 1
            writer.append(numbered(template, 1))
        with pytest.raises(UsageError, match="already; nothing was written"):
            writer.append(numbered(template, 1))
    with ShardWriter(path) as writer:
        assert len(writer.names) == 2
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.h5"]


def test_a_journal_of_another_file_is_not_applied(
    tmp_path: Path, template: EpisodeData
) -> None:
    path = tmp_path / "a.h5"
    with ShardWriter(path) as writer:
        writer.append(numbered(template, 0))
    fd = os.open(path, os.O_RDONLY)
    overlay = Overlay(fd, path.stat().st_size)
    overlay.seek(5000)
    overlay.write(b"changed")
    body = jn._pack(fd, overlay)
    os.close(fd)
    path.unlink()
    with ShardWriter(path) as writer:
        writer.append(numbered(template, 1))
    journal_path(path).write_bytes(body)
    before = path.read_bytes()
    for act in (open_shard, ShardWriter, repair):
        with pytest.raises(
            DamagedError, match=r"does not belong to a.h5.*delete the journal"
        ):
            act(path)
    assert path.read_bytes() == before and not lock_path(path).exists()


def test_overlay_is_a_file(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    path = tmp_path / "f"
    path.write_bytes(rng.bytes(20_000))
    fd = os.open(path, os.O_RDONLY)
    overlay = Overlay(fd, 20_000)
    model = io.BytesIO(path.read_bytes())
    for _ in range(300):
        at = int(rng.integers(0, 30_000))
        size = int(rng.integers(0, 9_000))
        overlay.seek(at)
        model.seek(at)
        if rng.random() < 0.5:
            data = rng.bytes(size)
            assert overlay.write(data) == model.write(data)
        else:
            got = bytearray(size)
            assert bytes(got[: overlay.readinto(got)]) == model.read(size)
        assert overlay.tell() == model.tell() and overlay.seek(0, os.SEEK_END) == len(
            model.getvalue()
        )
    assert overlay.truncate(25_000) == 25_000
    model.truncate(25_000)
    overlay.seek(0)
    assert overlay.read() == model.getvalue()[:25_000]
    os.close(fd)


def test_overlay_reads_beside_a_short_page(tmp_path: Path) -> None:
    path = tmp_path / "f"
    path.write_bytes(bytes(range(256)) * 64)
    fd = os.open(path, os.O_RDONLY)
    overlay = Overlay(fd, 16_384, {2: b"x" * 100})
    expected = bytearray(path.read_bytes())
    expected[8192:8292] = b"x" * 100
    for at, size in (
        (8192, 50),
        (8250, 100),
        (8300, 100),
        (9000, 3000),
        (0, 16_384),
        (16_384, 5),
    ):
        overlay.seek(at)
        assert overlay.read(size) == bytes(expected[at : at + size])
    os.close(fd)


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
