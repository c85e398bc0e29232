"""Packing: shards made of the episode files of a data set, to share them and to read them faster."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from mjhab.core.errors import fault
from mjhab.data.store.episode_files import EPISODE_FOLDER, EpisodeFiles, lock_set
from mjhab.data.store.hdf5 import drop_unfinished
from mjhab.data.store.places import is_leftover
from mjhab.data.store.reading import open_shard
from mjhab.data.store.storage import broken
from mjhab.data.store.writing import write_shard

# Large enough that a set has few files, small enough to upload and to check one at a time.
SHARD_MB = 512
"""Size up to which episodes are packed into one shard [MB]."""


@dataclass(frozen=True)
class Packed:
    """Number of episodes packed, the shards made of them, and the size of these [bytes]."""

    episodes: int
    shards: tuple[Path, ...]
    bytes: int


def pack(
    folder: Path, shard_mb: float = SHARD_MB, tell: Callable[[int], object] = bool
) -> Packed:
    """Make shards ``shard_NNN.h5`` of the episode files of a data set, and delete the files.

    A kill at any moment loses nothing; the next call goes on.

    Args:
        folder: of the data set, as `mjhab generate` makes it; its further shards stay as they are.
        shard_mb: approximate largest size of a shard [MB].
        tell: called with the number of episodes of each new shard.

    Raises:
        UsageError: there is no such folder, or a process is recording in it.
        DamagedError: an episode cannot be read; those before it are packed.
        StorageError: the disk is full; what is not packed stays as it is.
    """
    files = EpisodeFiles(folder / EPISODE_FOLDER)
    if not files.folder.is_dir():
        raise fault(
            folder,
            f"has no folder {EPISODE_FOLDER!r} of episode files: there is nothing to pack.",
        )
    shards: list[Path] = []
    episodes = size = 0
    with lock_set(folder):
        drop_unfinished(files.folder)
        drop_unfinished(folder, "shard_*")
        # Else they would be packed a second time.
        _drop_packed(folder, files)
        for batch in _batches(files.paths(), int(shard_mb * 1e6)):
            shard = _free_name(folder)
            try:
                write_shard(shard, {path: [name] for name, path in batch.items()})
            except OSError as error:
                raise broken(shard, error) from error
            for path in batch.values():
                # After the shard is whole under its name: a kill between leaves copies, which `_drop_packed` knows.
                path.unlink()
            shards.append(shard)
            episodes += len(batch)
            size += shard.stat().st_size
            tell(len(batch))
        shutil.rmtree(files.folder)
    return Packed(episodes, tuple(shards), size)


def _drop_packed(folder: Path, files: EpisodeFiles) -> None:
    """Delete the files whose episodes a killed process had packed already."""
    paths = files.paths()
    for shard in sorted(folder.glob("*.h5")) if paths else ():
        with open_shard(shard) as opened:
            names = opened.names
        for name in paths.keys() & set(names):
            if is_leftover(paths[name], shard, name):
                paths.pop(name).unlink()


def _batches(paths: Mapping[str, Path], limit: int) -> Iterator[dict[str, Path]]:
    """Divide files, in the order of their names, into batches of at most ``limit`` bytes; a larger one is alone."""
    batch: dict[str, Path] = {}
    total = 0
    for name, path in paths.items():
        size = path.stat().st_size
        # The first test lets a file that is larger than a shard be a shard of its own.
        if batch and total + size > limit:
            yield batch
            batch, total = {}, 0
        batch[name] = path
        total += size
    if batch:
        yield batch


def _free_name(folder: Path) -> Path:
    number = 0
    while (path := folder / f"shard_{number:03d}.h5").exists():
        number += 1
    return path
