"""The folders of a LeRobot data set: where tables, films and descriptions lie in v3.0 and in v2.1.

After lerobot 0.4.4 (v3.0) and 0.3.3 (v2.1): lerobot/datasets/utils.py and lerobot_dataset.py.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from mjhab.data.lerobot_stats import QUANTILES, Stats, aggregate
from mjhab.rollout.films import Film

OpenFilm = Callable[[Path, int], Film]
"""Opens a film file, given its path and frames per second."""
CHUNK = 1000
"""Files in a folder."""
DATA_MB, VIDEO_MB = 100, 200
"""About the largest size of a file of tables and of films in v3.0 [MB]."""
_MB = 1 << 20
_COMPRESSION = "zstd"


class Files(Protocol):
    """Where a version puts things. ``version``: its name; ``paths``: what info.json says of it."""

    version: str
    paths: dict[str, Any]

    def add_table(self, number: int, table: pa.Table) -> dict[str, Any]:
        """Write the rows of an episode; returns what the table of episodes says about them."""
        ...

    def add_film(self, number: int, key: str, frames: Iterable[np.ndarray], count: int, size: int) -> dict[str, Any]:
        """Write ``count`` frames of an episode that take about ``size`` bytes; returns the same."""
        ...

    def close(self, episodes: Sequence[dict[str, Any]], stats: Sequence[dict[str, Stats]]) -> None:
        """Finish the files and write the table of episodes and the statistics."""
        ...

    def write_names(self, what: str, names: Sequence[str]) -> None:
        """Write the list of tasks or subtasks; ``what`` is "task" or "subtask"."""
        ...

    def abort(self) -> None:
        """Let go of open files."""
        ...


class Files30:
    """v3.0: many episodes in a file."""

    version = "v3.0"

    def __init__(self, root: Path, fps: int, open_film: OpenFilm) -> None:
        self.root, self._fps, self._open_film = root, fps, open_film
        self.paths: dict[str, Any] = {
            "chunks_size": CHUNK,
            "data_files_size_in_mb": DATA_MB,
            "video_files_size_in_mb": VIDEO_MB,
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        }
        self._table: pq.ParquetWriter | None = None
        self._tables, self._table_size, self._rows = 0, 0, 0
        self._films: dict[str, _LongFilm] = {}

    def add_table(self, number: int, table: pa.Table) -> dict[str, Any]:
        """See `Files`."""
        if self._table is not None and self._table_size + table.nbytes > DATA_MB * _MB:
            self._table.close()
            self._table, self._tables, self._table_size = None, self._tables + 1, 0
        place = _place(self._tables)
        if self._table is None:
            path = _folder(self.root / self.paths["data_path"].format(**place))
            self._table = pq.ParquetWriter(path, table.schema, compression=_COMPRESSION)
        self._table.write_table(table)
        self._table_size += table.nbytes
        first, self._rows = self._rows, self._rows + len(table)
        whole = {"dataset_from_index": first, "dataset_to_index": self._rows}
        return {**{f"data/{name}": value for name, value in place.items()}, **whole}

    def add_film(self, number: int, key: str, frames: Iterable[np.ndarray], count: int, size: int) -> dict[str, Any]:
        """See `Files`."""
        film = self._films.setdefault(key, _LongFilm())
        if film.film is not None and film.size + size > VIDEO_MB * _MB:
            film.film.close()
            film.film, film.files, film.size, film.frames = None, film.files + 1, 0, 0
        place = _place(film.files)
        if film.film is None:
            film.film = self._open_film(self.root / self.paths["video_path"].format(video_key=key, **place), self._fps)
        for frame in frames:
            film.film.add(frame)
        first, film.frames, film.size = film.frames, film.frames + count, film.size + size
        times = {"from_timestamp": first / self._fps, "to_timestamp": film.frames / self._fps}
        return {f"videos/{key}/{name}": value for name, value in {**place, **times}.items()}

    def close(self, episodes: Sequence[dict[str, Any]], stats: Sequence[dict[str, Stats]]) -> None:
        """See `Files`."""
        if self._table is not None:
            self._table.close()
        for film in self._films.values():
            if film.film is not None:
                film.film.close()
        rows = [
            {**row, **_flat(each), "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
            for row, each in zip(episodes, stats, strict=True)
        ]
        path = _folder(self.root / "meta/episodes/chunk-000/file-000.parquet")
        pq.write_table(pa.Table.from_pylist(rows), path, compression=_COMPRESSION)
        write_json(self.root / "meta/stats.json", _lists(aggregate(stats)))

    def write_names(self, what: str, names: Sequence[str]) -> None:
        """See `Files`."""
        table = pa.table({f"{what}_index": pa.array(range(len(names)), pa.int64()), _INDEX: list(names)})
        meta = json.dumps(_pandas(f"{what}_index"))
        pq.write_table(table.replace_schema_metadata({"pandas": meta}), _folder(self.root / f"meta/{what}s.parquet"))

    def abort(self) -> None:
        """See `Files`."""
        for film in self._films.values():
            if film.film is not None:
                film.film.abort()


class Files21:
    """v2.1: one file of rows, and one film per camera, for each episode."""

    version = "v2.1"

    def __init__(self, root: Path, fps: int, open_film: OpenFilm) -> None:
        self.root, self._fps, self._open_film = root, fps, open_film
        self.paths: dict[str, Any] = {
            "total_videos": 0,
            "total_chunks": 0,
            "chunks_size": CHUNK,
            "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
            "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
        }
        self._film: Film | None = None

    def add_table(self, number: int, table: pa.Table) -> dict[str, Any]:
        """See `Files`."""
        chunk = number // CHUNK
        self.paths["total_chunks"] = chunk + 1
        name = self.paths["data_path"].format(episode_chunk=chunk, episode_index=number)
        pq.write_table(table, _folder(self.root / name), compression=_COMPRESSION)
        return {}

    def add_film(self, number: int, key: str, frames: Iterable[np.ndarray], count: int, size: int) -> dict[str, Any]:
        """See `Files`."""
        name = self.paths["video_path"].format(episode_chunk=number // CHUNK, video_key=key, episode_index=number)
        self._film = self._open_film(self.root / name, self._fps)
        for frame in frames:
            self._film.add(frame)
        self._film.close()
        self._film = None
        self.paths["total_videos"] += 1
        return {}

    def close(self, episodes: Sequence[dict[str, Any]], stats: Sequence[dict[str, Stats]]) -> None:
        """See `Files`."""
        write_lines(self.root / "meta/episodes.jsonl", episodes)
        # v2.1 knows no quantiles.
        plain = [{k: {n: v for n, v in s.items() if n not in QUANTILES} for k, s in each.items()} for each in stats]
        rows = [{"episode_index": number, "stats": _lists(each)} for number, each in enumerate(plain)]
        write_lines(self.root / "meta/episodes_stats.jsonl", rows)

    def write_names(self, what: str, names: Sequence[str]) -> None:
        """See `Files`."""
        write_lines(self.root / f"meta/{what}s.jsonl", [{f"{what}_index": i, what: n} for i, n in enumerate(names)])

    def abort(self) -> None:
        """See `Files`."""
        if self._film is not None:
            self._film.abort()


VERSIONS: dict[str, type[Files30] | type[Files21]] = {"3.0": Files30, "2.1": Files21}
"""Versions of the format that can be written."""


class _LongFilm:
    """The film file of a camera that is being written."""

    def __init__(self) -> None:
        self.film: Film | None = None
        self.files = self.size = self.frames = 0


def write_json(path: Path, value: Any) -> None:
    """Write JSON for people to read too."""
    _folder(path).write_text(json.dumps(value, indent=4, ensure_ascii=False), encoding="utf-8")


def write_lines(path: Path, rows: Iterable[Any]) -> None:
    """Write one line of JSON per row."""
    _folder(path).write_text("".join(json.dumps(row, ensure_ascii=False) + "\n" for row in rows), encoding="utf-8")


_INDEX = "__index_level_0__"


def _pandas(column: str) -> dict[str, Any]:
    """What pandas keeps in a file to know that texts are the index of its table: LeRobot reads them as that."""

    def entry(name: str | None, field: str, kind: str, numpy: str) -> dict[str, Any]:
        return {"name": name, "field_name": field, "pandas_type": kind, "numpy_type": numpy, "metadata": None}

    return {
        "index_columns": [_INDEX],
        "column_indexes": [
            {
                "name": None,
                "field_name": None,
                "pandas_type": "unicode",
                "numpy_type": "object",
                "metadata": {"encoding": "UTF-8"},
            }
        ],
        "columns": [entry(column, column, "int64", "int64"), entry(None, _INDEX, "unicode", "object")],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.0.0",
    }


def _place(number: int) -> dict[str, int]:
    return {"chunk_index": number // CHUNK, "file_index": number % CHUNK}


def _folder(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _lists(stats: Mapping[str, Stats]) -> dict[str, dict[str, Any]]:
    return {key: {name: value.tolist() for name, value in each.items()} for key, each in stats.items()}


def _flat(stats: Mapping[str, Stats]) -> dict[str, Any]:
    return {f"stats/{key}/{name}": value for key, each in _lists(stats).items() for name, value in each.items()}
