"""The file layout of a LeRobot data set: paths of tables, videos and metadata in v3.0 and in v2.1.

After lerobot 0.4.4 (v3.0) and 0.3.3 (v2.1): lerobot/datasets/utils.py and lerobot_dataset.py.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from mjhab.core.names import below
from mjhab.data.export.lerobot.parts import EpisodeParts, ExportedEpisode
from mjhab.data.export.lerobot.stats import QUANTILES, Stats, aggregate, quantiles_of

CHUNK = 1000
"""Number of files per folder."""
DATA_MB = 100
VIDEO_MB = 200
"""Approximate largest size of table and video files in v3.0 [MB]."""
_MB = 1 << 20
_COMPRESSION = "zstd"


class Files(Protocol):
    """File layout of a version of the format. version: its name. paths: its entries in info.json."""

    version: str
    paths: dict[str, Any]

    def arrange(self, parts: EpisodeParts, made: Sequence[ExportedEpisode]) -> None:
        """Move or join the parts of all episodes into the final files, and add their places to the episodes' rows.

        After an interruption it can be called again: existing files are kept, and parts are deleted once used.
        """
        ...

    def describe(
        self, episodes: Sequence[dict[str, Any]], stats: Sequence[dict[str, Stats]]
    ) -> None:
        """Write the table of episodes and the statistics."""
        ...

    def write_names(self, what: str, names: Sequence[str]) -> None:
        """Write the list of tasks, subtasks, actors or skills; ``what`` is "task", "subtask", "actor" or "skill"."""
        ...


class Files30:
    """v3.0: many episodes in a file."""

    version = "v3.0"

    def __init__(self, root: Path, fps: int) -> None:
        self.root = root
        self._fps = fps
        self.paths: dict[str, Any] = {
            "chunks_size": CHUNK,
            "data_files_size_in_mb": DATA_MB,
            "video_files_size_in_mb": VIDEO_MB,
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        }

    def arrange(self, parts: EpisodeParts, made: Sequence[ExportedEpisode]) -> None:
        """See `Files`."""
        first = 0
        for file, numbers in enumerate(
            _packed([each.size for each in made], DATA_MB * _MB)
        ):
            place = _place(file)
            parts.join_tables(
                numbers, below(self.root, self.paths["data_path"].format(**place))
            )
            for number in numbers:
                last = first + made[number].steps
                made[number].row.update(
                    {f"data/{name}": value for name, value in place.items()}
                )
                made[number].row.update(dataset_from_index=first, dataset_to_index=last)
                first = last
        for key in made[0].films:
            self._arrange_films(parts, made, key)

    def _arrange_films(
        self, parts: EpisodeParts, made: Sequence[ExportedEpisode], key: str
    ) -> None:
        for file, numbers in enumerate(
            _packed([each.films[key] for each in made], VIDEO_MB * _MB)
        ):
            place = _place(file)
            first = 0
            parts.join_films(
                numbers,
                key,
                below(self.root, self.paths["video_path"].format(video_key=key, **place)),
            )
            for number in numbers:
                last = first + made[number].steps
                times = {
                    "from_timestamp": first / self._fps,
                    "to_timestamp": last / self._fps,
                }
                made[number].row.update(
                    {f"videos/{key}/{name}": v for name, v in {**place, **times}.items()}
                )
                first = last

    def describe(
        self, episodes: Sequence[dict[str, Any]], stats: Sequence[dict[str, Stats]]
    ) -> None:
        """See `Files`."""
        rows = [
            {
                **row,
                **_flat(each),
                # One file holds the rows of all episodes; LeRobot looks up its number in each row.
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
            for row, each in zip(episodes, stats, strict=True)
        ]
        # Rows of episodes are a few kB each, so that they never reach the size of a second file.
        path = _folder(self.root / "meta/episodes/chunk-000/file-000.parquet")
        pq.write_table(pa.Table.from_pylist(rows), path, compression=_COMPRESSION)
        whole = aggregate(stats)
        for key, each in self._quantiles(whole).items():
            whole[key] |= each
        write_json(self.root / "meta/stats.json", stats_lists(whole))

    def _quantiles(self, stats: Mapping[str, Stats]) -> dict[str, Stats]:
        """Quantiles of all rows, of the features that are numbers or lists of them.

        LeRobot's own are means of those of the episodes, which are quantiles of nothing where episodes differ.
        """
        paths = sorted((self.root / "data").rglob("*.parquet"))
        found = {}
        for key, kind in zip(*_schema(paths[0]), strict=True):
            wide = pa.types.is_fixed_size_list(kind)
            # Images and maps keep the quantiles of their samples: all their pixels would not fit in memory.
            if key not in stats or (pa.types.is_nested(kind) and not wide):
                continue
            parts = [pq.read_table(path, columns=[key]).column(key) for path in paths]
            # The flatten of a chunked array splits structures and leaves lists as they are.
            chunks = [chunk for part in parts for chunk in part.chunks]
            rows = [chunk.flatten() if wide else chunk for chunk in chunks]
            values = np.concatenate([row.to_numpy(zero_copy_only=False) for row in rows])
            # Quantiles of bool and integer columns interpolate between values.
            columns = values.reshape(-1, kind.list_size if wide else 1).astype(np.float64)
            found[key] = quantiles_of(columns)
        return found

    def write_names(self, what: str, names: Sequence[str]) -> None:
        """See `Files`."""
        table = pa.table(
            {
                f"{what}_index": pa.array(range(len(names)), pa.int64()),
                _INDEX: list(names),
            }
        )
        meta = json.dumps(_pandas(f"{what}_index"))
        pq.write_table(
            table.replace_schema_metadata({"pandas": meta}),
            _folder(self.root / f"meta/{what}s.parquet"),
        )


class Files21:
    """v2.1: one file of rows, and one film per camera, for each episode."""

    version = "v2.1"

    def __init__(self, root: Path, fps: int) -> None:
        self.root = root
        self.paths: dict[str, Any] = {
            "total_videos": 0,
            "total_chunks": 0,
            "chunks_size": CHUNK,
            "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
            "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
        }

    def arrange(self, parts: EpisodeParts, made: Sequence[ExportedEpisode]) -> None:
        """See `Files`."""
        # Only now is the number of episodes known, and info.json of v2.1 must hold it.
        self.paths["total_chunks"] = -(-len(made) // CHUNK)
        self.paths["total_videos"] = sum(len(each.films) for each in made)
        for number, each in enumerate(made):
            place = {"episode_chunk": number // CHUNK, "episode_index": number}
            parts.join_tables(
                [number], below(self.root, self.paths["data_path"].format(**place))
            )
            for key in each.films:
                path = below(
                    self.root, self.paths["video_path"].format(video_key=key, **place)
                )
                parts.join_films([number], key, path)

    def describe(
        self, episodes: Sequence[dict[str, Any]], stats: Sequence[dict[str, Stats]]
    ) -> None:
        """See `Files`."""
        write_lines(self.root / "meta/episodes.jsonl", episodes)
        # v2.1 has no quantiles.
        plain = [
            {
                k: {n: v for n, v in s.items() if n not in QUANTILES}
                for k, s in each.items()
            }
            for each in stats
        ]
        rows = [
            {"episode_index": number, "stats": stats_lists(each)}
            for number, each in enumerate(plain)
        ]
        write_lines(self.root / "meta/episodes_stats.jsonl", rows)

    def write_names(self, what: str, names: Sequence[str]) -> None:
        """See `Files`."""
        write_lines(
            self.root / f"meta/{what}s.jsonl",
            [{f"{what}_index": i, what: n} for i, n in enumerate(names)],
        )


VERSIONS: dict[str, type[Files30] | type[Files21]] = {"3.0": Files30, "2.1": Files21}
"""Supported versions of the format."""


def _packed(sizes: Sequence[int], most: int) -> list[list[int]]:
    """Group consecutive indices so that the sizes of a group sum to at most ``most``; a larger one is alone."""
    groups: list[list[int]] = []
    total = 0
    for number, size in enumerate(sizes):
        # The first test lets an episode that is larger than a file be a file of its own.
        if not groups or total + size > most:
            groups.append([])
            total = 0
        groups[-1].append(number)
        total += size
    return groups


def write_json(path: Path, value: Any) -> None:
    """Write indented JSON."""
    _folder(path).write_text(
        json.dumps(value, indent=4, ensure_ascii=False), encoding="utf-8"
    )


def write_lines(path: Path, rows: Iterable[Any]) -> None:
    """Write one line of JSON per row."""
    _folder(path).write_text(
        "".join(json.dumps(row, ensure_ascii=False) + "\n" for row in rows),
        encoding="utf-8",
    )


_INDEX = "__index_level_0__"


def _pandas(column: str) -> dict[str, Any]:
    """Pandas metadata that marks the text column as the table's index, as LeRobot expects."""

    def entry(name: str | None, field: str, kind: str, numpy: str) -> dict[str, Any]:
        return {
            "name": name,
            "field_name": field,
            "pandas_type": kind,
            "numpy_type": numpy,
            "metadata": None,
        }

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
        "columns": [
            entry(column, column, "int64", "int64"),
            entry(None, _INDEX, "unicode", "object"),
        ],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.0.0",
    }


def _schema(path: Path) -> tuple[list[str], list[pa.DataType]]:
    schema = pq.read_schema(path)
    return schema.names, schema.types


def _place(number: int) -> dict[str, int]:
    return {"chunk_index": number // CHUNK, "file_index": number % CHUNK}


def _folder(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def stats_lists(stats: Mapping[str, Stats]) -> dict[str, dict[str, Any]]:
    """Statistics as JSON data."""
    return {
        key: {name: value.tolist() for name, value in each.items()}
        for key, each in stats.items()
    }


def _flat(stats: Mapping[str, Stats]) -> dict[str, Any]:
    return {
        f"stats/{key}/{name}": value
        for key, each in stats_lists(stats).items()
        for name, value in each.items()
    }
