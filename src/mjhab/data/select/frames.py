"""Camera images of many episodes for training, decoded once and then copied from memory.

Decoding a PNG of 128 x 128 px takes about 0.3 ms, copying its pixels 3 us. The decoded images of each camera output lie
in one memory mapping, which forked data loader workers share.
"""

from __future__ import annotations

import mmap
import os
import tempfile
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.core.errors import UsageError
from mjhab.data.store.images import decode
from mjhab.data.store.reading import RecordedEpisode, open_shard
from mjhab.data.store.schema import DamagedError

# Far below the usual limit of 1,024 descriptors per process, of which torch needs some too.
_OPEN = 64
"""Largest number of shards that a process keeps open."""


@dataclass(frozen=True)
class EncodedFrames:
    """Location of the encoded images of one camera of an episode.

    path: the shard. name: of the episode. offset: of the first image in the file [bytes]. ends (count,): end of each
    image from there [bytes]; None if only HDF5 can read them. shape (C, H, W), dtype: of a decoded image.
    """

    path: Path
    name: str
    camera: str
    output: str
    offset: int
    ends: np.ndarray | None
    count: int
    shape: tuple[int, ...]
    dtype: np.dtype

    @classmethod
    def of(cls, episode: RecordedEpisode, image: str, count: int) -> EncodedFrames:
        """The first ``count`` images "<camera>/<output>" of an episode.

        Raises:
            UsageError: the episode has no such images.
        """
        camera, _, output = image.partition("/")
        offset, ends = episode.frame_places(camera, output) or (0, None)
        # Decoded once here, because shape and type stand in no header of the dataset.
        first = episode.frame(camera, output, 0).transpose(2, 0, 1)
        path = episode.shard.path
        return cls(
            path,
            episode.name,
            camera,
            output,
            offset,
            ends,
            count,
            first.shape,
            first.dtype,
        )

    def read(self, t: int, files: OpenFiles) -> np.ndarray:
        """The image of state t (C, H, W).

        Raises:
            DamagedError: the image cannot be read.
        """
        # HDF5 has no single offset for datasets in chunks or in the header.
        if self.ends is None:
            with open_shard(self.path) as shard:
                image = shard.episode(self.name).frame(self.camera, self.output, t)
            return image.transpose(2, 0, 1)
        start = int(self.ends[t - 1]) if t else 0
        try:
            # HDF5 is not thread-safe and does not survive a fork; a plain read does.
            data = os.pread(
                files.get(self.path), int(self.ends[t]) - start, self.offset + start
            )
            image = decode(data, self.output).transpose(2, 0, 1)
            if image.shape != self.shape:
                raise ValueError(f"its shape is {image.shape}, not {self.shape}")
        except (OSError, ValueError) as error:
            raise DamagedError(
                f"image {t} of {self.camera} {self.output} in episode {self.name} of {self.path} cannot be read: "
                f"{error}. The file may have been replaced; check it with: mjhab data check {self.path}"
            ) from error
        return image


class OpenFiles:
    """Files open for reading. All reads pass their own offset, so processes may share them after a fork."""

    def __init__(self) -> None:
        self._open: OrderedDict[Path, int] = OrderedDict()

    def get(self, path: Path) -> int:
        """Descriptor of a file."""
        if path not in self._open:
            self._open[path] = os.open(path, os.O_RDONLY)
            if len(self._open) > _OPEN:
                # The one that was used longest ago.
                os.close(self._open.popitem(last=False)[1])
        self._open.move_to_end(path)
        return self._open[path]

    def __del__(self) -> None:
        for fd in self._open.values():
            os.close(fd)


class FrameStore:
    """The images of one camera output of all episodes, in sequence, one row per state.

    Args:
        episodes: locations of the images; all must have the same size.
        keeps: keep decoded images.
        folder: folder of an unnamed file that holds the decoded images, so that they may be larger than the memory;
            None keeps them in memory.

    Raises:
        UsageError: the sizes of the images differ, or the folder has no room.
    """

    def __init__(
        self, episodes: Sequence[EncodedFrames], keeps: bool, folder: Path | None = None
    ) -> None:
        self._episodes = tuple(episodes)
        self._starts = np.cumsum([0, *(each.count for each in episodes)])
        self._keeps = keeps
        self._folder = folder
        self._shape, self._dtype = _one_size(self._episodes)
        self._open()

    def _open(self) -> None:
        self._files = OpenFiles()
        self._pixels: np.ndarray | None = None
        if self._keeps:
            rows = int(self._starts[-1])
            # The mapping takes memory only for rows that are written, that is, rows that were requested.
            whole = _mapping(self.nbytes + rows, self._folder)
            pixels = np.frombuffer(
                whole, self._dtype, self.nbytes // self._dtype.itemsize
            )
            self._pixels = pixels.reshape(rows, *self._shape)
            # In the same mapping, so that forked loaders see which images others have decoded.
            self._known = np.frombuffer(whole, np.uint8, rows, self.nbytes)

    @property
    def nbytes(self) -> int:
        """Bytes of all images, decoded."""
        return decoded_bytes(self._episodes)

    def rows(self, rows: np.ndarray) -> np.ndarray:
        """The images (n, C, H, W) of the states ``rows`` (n,), counted over all episodes."""
        if self._pixels is None:
            # Windows of one batch overlap, and decoding is the slow part.
            unique, back = np.unique(rows, return_inverse=True)
            return np.stack([self._decoded(row) for row in unique.tolist()])[back]
        for row in np.unique(rows[self._known[rows] == 0]).tolist():
            self._pixels[row] = self._decoded(row)
            # Set after the pixels, so that another process that sees the mark finds complete pixels.
            self._known[row] = 1
        return self._pixels[rows]

    def _decoded(self, row: int) -> np.ndarray:
        episode = int(np.searchsorted(self._starts, row, side="right")) - 1
        return self._episodes[episode].read(row - int(self._starts[episode]), self._files)

    def __getstate__(self) -> dict[str, Any]:
        """State for a spawned process, which decodes its own images."""
        return {
            k: v
            for k, v in self.__dict__.items()
            if k not in ("_files", "_pixels", "_known")
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._open()


def decoded_bytes(episodes: Sequence[EncodedFrames]) -> int:
    """Bytes of all images of episodes once they are decoded."""
    return sum(
        each.count * int(np.prod(each.shape, dtype=np.int64)) * each.dtype.itemsize
        for each in episodes
    )


def _one_size(episodes: Sequence[EncodedFrames]) -> tuple[tuple[int, ...], np.dtype]:
    first = episodes[0]
    for each in episodes:
        if (each.shape, each.dtype) != (first.shape, first.dtype):
            raise UsageError(
                f"images {first.camera}/{first.output} of episode {each.name} of {each.path} are {each.shape}, "
                f"those of {first.name} are {first.shape} (channels, height, width); choose one size by the filter."
            )
    return first.shape, first.dtype


def _mapping(size: int, folder: Path | None) -> mmap.mmap:
    """A zero-filled mapping that forked processes share, in memory or in an unnamed file in ``folder``."""
    if folder is None:
        return mmap.mmap(-1, size)
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            # A sparse file on a full disk would kill the process by SIGBUS when a page is written.
            os.posix_fallocate(file.fileno(), 0, size)
            return mmap.mmap(file.fileno(), size)
    except OSError as error:
        raise UsageError(
            f"decoded images take {size / 2**30:.1f} GiB, which {folder} cannot hold: {error.strerror}. Name a folder "
            "with enough space, or give frames='decode' to decode them on every access."
        ) from error
