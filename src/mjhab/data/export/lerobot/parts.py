"""Files that a LeRobot export writes per episode, so that an interrupted export can continue.

<number>.parquet      the rows of an episode
<number>.<key>.mp4    a video of it
<number>.json         its metadata; written last, so it marks a finished episode

At the end they are joined into files of many episodes. Videos are joined without re-encoding.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from mjhab.core.files.cache import write_atomic
from mjhab.core.names import below
from mjhab.data.export.lerobot.stats import Stats
from mjhab.rollout.films import Film

_COMPRESSION = "zstd"


@dataclass(frozen=True)
class FilmTools:
    """Functions that write videos.

    open: opens a video for a path and frames per second. join: concatenates videos into a new one without re-encoding.
    settings: JSON data that determines the videos; an interrupted export can only be resumed with equal settings.
    read: frames (H, W, 3) uint8 of a video, to tell how well it shows the images; None leaves that out.
    """

    open: Callable[[Path, int], Film]
    join: Callable[[Sequence[Path], Path], object]
    settings: Mapping[str, Any] = field(default_factory=dict)
    read: Callable[[Path], Iterable[np.ndarray]] | None = None


@dataclass(frozen=True)
class ExportedEpisode:
    """Metadata of an exported episode, JSON data except for ``stats``.

    row: of the table of episodes. stats: statistics per feature. size: of its rows in memory [bytes].
    films: size of each video [bytes]. subtasks: instructions of its plan's subtasks. actors: names of its actors.
    licence: of the assets. skills: names of what they did. psnr: how well videos show the images [dB], of the episode
    for which that is measured. interventions: number of its rows that are corrections.
    """

    row: dict[str, Any]
    stats: dict[str, Stats]
    size: int
    films: dict[str, int]
    subtasks: list[str]
    actors: list[str]
    licence: str
    skills: list[str] = field(default_factory=list)
    psnr: dict[str, float] = field(default_factory=dict)
    interventions: int = 0

    @property
    def steps(self) -> int:
        """Number of rows of the episode."""
        return self.row["length"]


class EpisodeParts:
    """The per-episode files in a folder, by number of the episode."""

    def __init__(self, folder: Path, fps: int, films: FilmTools) -> None:
        self._folder = folder
        self._fps = fps
        self._tools = films

    def made(self, number: int) -> ExportedEpisode | None:
        """Metadata of a finished episode; None if it is not finished."""
        # The metadata are written last, so that they alone tell whether the other parts are whole.
        path = self._path(number, "json")
        if not path.exists():
            return None
        plain = json.loads(path.read_text(encoding="utf-8"))
        plain["stats"] = {
            key: {name: np.array(value) for name, value in each.items()}
            for key, each in plain["stats"].items()
        }
        return ExportedEpisode(**plain)

    def add_table(self, number: int, table: pa.Table) -> None:
        """Write the rows of an episode."""
        path = self._path(number, "parquet")
        pq.write_table(table, path, compression=_COMPRESSION)
        _sync(path)

    def add_film(self, number: int, key: str, frames: Iterable[np.ndarray]) -> int:
        """Write a video of an episode; returns its size [bytes]."""
        path = self._path(number, f"{key}.mp4")
        film = self._tools.open(path, self._fps)
        try:
            for frame in frames:
                film.add(frame)
            film.close()
        except BaseException:
            # An encoder that is left open would keep its process and an unreadable file.
            film.abort()
            raise
        _sync(path)
        return path.stat().st_size

    def shown(self, number: int, key: str) -> Iterable[np.ndarray]:
        """Frames of a video of an episode as they are shown; none if nothing reads them."""
        read = self._tools.read
        return () if read is None else read(self._path(number, f"{key}.mp4"))

    def finish(self, number: int, made: ExportedEpisode) -> None:
        """Mark an episode as finished by writing its metadata."""
        plain = asdict(made)
        plain["stats"] = {
            key: {name: v.tolist() for name, v in each.items()}
            for key, each in made.stats.items()
        }
        text = json.dumps(plain, ensure_ascii=False)
        # A half-written file here would make an unfinished episode look finished.
        write_atomic(
            self._path(number, "json"),
            lambda path: path.write_text(text, encoding="utf-8"),
        )

    def join_tables(self, numbers: Sequence[int], out: Path) -> None:
        """Join the rows of episodes into one file, unless it exists, and delete their parts."""

        def join(paths: Sequence[Path], whole: Path) -> None:
            with pq.ParquetWriter(
                whole, pq.read_schema(paths[0]), compression=_COMPRESSION
            ) as writer:
                for path in paths:
                    writer.write_table(pq.read_table(path))

        self._join(numbers, "parquet", out, join)

    def join_films(self, numbers: Sequence[int], key: str, out: Path) -> None:
        """Join videos of episodes into one file, unless it exists, and delete their parts."""
        self._join(numbers, f"{key}.mp4", out, self._tools.join)

    def _join(
        self,
        numbers: Sequence[int],
        kind: str,
        out: Path,
        join: Callable[[Sequence[Path], Path], object],
    ) -> None:
        paths = [self._path(number, kind) for number in numbers]
        # An interrupted call may have joined them already and died before it deleted the parts.
        if not out.exists():
            out.parent.mkdir(parents=True, exist_ok=True)
            whole = paths[0]
            # A single part is moved, not copied: re-encoding or copying a film costs time and disk.
            if len(paths) > 1:
                whole = below(self._folder, f"joined.{kind}")
                join(paths, whole)
                # The parts are deleted below, so the joined file must be on the disk first.
                _sync(whole)
            os.replace(whole, out)
        for path in paths:
            # The only part was moved, and an earlier call may have deleted some.
            path.unlink(missing_ok=True)

    def _path(self, number: int, kind: str) -> Path:
        return below(self._folder, f"{number:06d}.{kind}")


def _sync(path: Path) -> None:
    """Flush a file to the disk, so that it is there before the file that marks its episode as finished."""
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
