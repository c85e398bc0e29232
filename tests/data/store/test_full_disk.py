"""Exports and parts on a full disk: a message, nothing that looks whole, and the same command works afterwards."""

from __future__ import annotations

import errno
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from mjhab.data.export.lerobot.parts import FilmTools
from mjhab.data.select.sets import split
from mjhab.data.store import hdf5
from mjhab.data.store.storage import StorageError
from mjhab.render.film import FilmWriter, join_films
from tests.data.export.exporting import to_lerobot, to_maniskill
from tests.data.make import record_pictures
from tests.data.store.test_crash import small_disk

ANEW = "the disk is full. Nothing was left behind; free some space and run the same command again"
RESUME = "the disk is full. Finished parts are kept; free some space and run the same command with --resume"
Write = Callable[..., Any]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("source")
    record_pictures(folder / "a.h5", range(3))
    return folder


def full_after(calls: int, real: Callable[..., Any]) -> Callable[..., Any]:
    """A function that meets a full disk in its call of that number, and in all later ones."""
    left = [calls]

    def limited(*args: Any, **options: Any) -> Any:
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(*args, **options)

    return limited


def lerobot(source: Path, out: Path, **options: Any) -> None:
    to_lerobot(source, out, FilmTools(FilmWriter, join_films), **options)


def maniskill(source: Path, out: Path, **options: Any) -> None:
    to_maniskill(source, out, **options)


def parts(source: Path, out: Path) -> None:
    split([source], out, {"train": 0.6, "val": 0.4})


def check(write: Write, source: Path, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    resumes = write is not parts
    with pytest.raises(StorageError, match=RESUME if resumes else ANEW):
        write(source, out)
    assert not list(out.glob("*"))
    assert resumes or [path for path in out.parent.rglob("*") if path.is_file()] == []
    monkeypatch.undo()
    write(source, out, **({"resume": True} if resumes else {}))
    assert sum(path.is_file() for path in out.rglob("*")) >= 2
    assert not [path for path in out.parent.rglob(".*")]


@pytest.mark.parametrize("writes", [1, 2, 20])
@pytest.mark.parametrize("write", [maniskill, parts])
def test_hdf5(
    source: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    write: Write,
    writes: int,
) -> None:
    monkeypatch.setattr(hdf5.io, "FileIO", small_disk(writes))
    check(write, source, tmp_path / "out", monkeypatch)


def test_tables(source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        pq.ParquetWriter, "write_table", full_after(1, pq.ParquetWriter.write_table)
    )
    check(lerobot, source, tmp_path / "out", monkeypatch)


def test_films(source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An encoder that ended with the words of a full disk."""
    start = FilmWriter._start

    def on_full_disk(self: FilmWriter, height: int, width: int) -> Any:
        process = start(self, height, width)
        process.kill()
        process.wait()
        self._log.write(b"Error writing trailer: No space left on device")
        return process

    monkeypatch.setattr(FilmWriter, "_start", on_full_disk)
    check(lerobot, source, tmp_path / "out", monkeypatch)
