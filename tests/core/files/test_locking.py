"""Locks of files and folders: one writer, and no trace when it is gone."""

from __future__ import annotations

import fcntl
import importlib.util
import os
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from mjhab.core.files.locking import (
    WriteLock,
    is_written,
    lock_path,
    refuse_if_written,
)
from tests.refusals import refused


def test_a_second_writer_is_told_who_the_first_is(tmp_path: Path) -> None:
    file = tmp_path / "data"
    refuse_if_written(file)
    lock = WriteLock(file)
    assert is_written(file)
    for attempt in (WriteLock, refuse_if_written):
        with refused(where="data", said="is being written by process"):
            attempt(file)
    with refused(said="another folder"):
        WriteLock(file, tmp_path)
    for _ in range(2):
        lock.release()
        assert not is_written(file) and list(tmp_path.iterdir()) == []
    with WriteLock(file):
        assert is_written(file)
    assert not is_written(file)


def test_the_lock_file_of_a_killed_writer_is_taken_over(tmp_path: Path) -> None:
    file = tmp_path / "data"
    lock_path(file).write_text("process 1 on a machine that is off\n")
    assert not is_written(file)
    lock = WriteLock(file)
    assert is_written(file)
    lock.release()


def test_a_writer_of_an_earlier_version_is_respected(tmp_path: Path) -> None:
    file = tmp_path / "data"
    fd = os.open(lock_path(file), os.O_RDWR | os.O_CREAT, 0o666)
    fcntl.flock(fd, fcntl.LOCK_EX)
    os.pwrite(fd, b"process 1 on another machine\n", 0)
    with refused(said="process 1 on another machine"):
        WriteLock(file)
    os.close(fd)
    WriteLock(file).release()


def test_a_file_system_without_locks_goes_without(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unsupported(*_: Any) -> None:
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(fcntl, "flock", unsupported)
    lock = WriteLock(tmp_path / "data")
    assert not is_written(tmp_path / "data")
    lock.release()
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_written_is_not_taken_for_one_without_locks(
    tmp_path: Path,
) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError):
        WriteLock(tmp_path / "file" / "data")


def test_a_system_without_flock_reads_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = importlib.util.find_spec("mjhab.core.files.locking")
    assert spec is not None and spec.loader is not None
    locking = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "fcntl", None)
    spec.loader.exec_module(locking)
    file = tmp_path / "data"
    with locking.WriteLock(file):
        assert not locking.is_written(file)


def test_readers_of_a_folder_that_may_not_be_written_see_who_writes(
    tmp_path: Path,
) -> None:
    """Looking takes no file and no right to write."""
    file = tmp_path / "data"
    with WriteLock(file):
        lock_path(file).chmod(0o444)
        before = lock_path(file).stat().st_mtime_ns
        assert is_written(file) and is_written(file)
        assert lock_path(file).stat().st_mtime_ns == before


def test_a_glance_at_a_lock_refuses_no_writer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another process asks whether somebody writes in the very instant in which a writer begins."""
    file = tmp_path / "data"
    glance = os.open(lock_path(file), os.O_RDWR | os.O_CREAT)
    fcntl.flock(glance, fcntl.LOCK_SH)
    monkeypatch.setattr(time, "sleep", lambda seconds: os.close(glance))
    lock = WriteLock(file)
    assert is_written(file)
    lock.release()
