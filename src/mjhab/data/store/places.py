"""The files of episodes in files and folders, and the episodes in them."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from mjhab.core.errors import UsageError, fault
from mjhab.data.store.episode_files import (
    EpisodeEntry,
    entries_of,
    is_episode_file,
    part_folder,
)
from mjhab.data.store.reading import RecordedEpisode, open_shard

Place = tuple[Path, str]
"""File and name of an episode."""


def shard_paths(places: Path | Sequence[Path]) -> list[Path]:
    """Files of episodes among the given files and, recursively, in the given folders.

    Shards come before files of single episodes; within a folder they are sorted by name. To a shard belong the episodes
    that are being recorded into it (`ShardWriter`). A file that is named twice, or by a link, too, is there once.

    Raises:
        UsageError: no place is given, a place does not exist, or a folder has no shards.
    """
    if not isinstance(places, Path) and not places:
        raise UsageError("name shards (*.h5), or folders of shards.")
    found: list[Path] = []
    for place in [places] if isinstance(places, Path) else places:
        inside = _files_in(place)
        if not inside and place.is_dir():
            raise UsageError(f"no shards (*.h5) in {place} or the folders in it.")
        if not inside:
            raise fault(
                place, "does not exist; give a shard (*.h5) or a folder of shards."
            )
        found += inside
    by_file: dict[Path, Path] = {}
    # Shards first: of an episode in both, the copy in the shard counts.
    for path in sorted(found, key=is_episode_file):
        # Resolved, so that a file given twice or by a link counts once, under the name given first.
        by_file.setdefault(path.resolve(), path)
    return list(by_file.values())


def shards_in(folder: Path) -> Iterator[Path]:
    """Files of episodes in a folder and the folders in it, in no order; none if the folder does not exist.

    Whoever records into the folder makes and deletes folders there, so one that is gone when its turn comes is passed
    over (`Path.rglob` raises). A name with a dot in front is of a file that is being written.
    """
    for inside, _, names in os.walk(folder):
        yield from (
            Path(inside, name)
            for name in names
            if name.endswith(".h5") and not name.startswith(".")
        )


def has_shards(folder: Path) -> bool:
    """Whether a folder, or a folder in it, has files of episodes."""
    return next(shards_in(folder), None) is not None


def _files_in(place: Path) -> list[Path]:
    if place.is_dir():
        return sorted(shards_in(place))
    parts = [p for p in part_folder(place).glob("*.h5") if not p.name.startswith(".")]
    return [*([place] if place.is_file() else []), *sorted(parts)]


def entries(
    places: Path | Sequence[Path], copies: bool = False
) -> Iterator[EpisodeEntry]:
    """Iterate over what filters ask of the episodes of shards and folders; see `episodes`."""
    once = _Once(copies)
    # The table of a folder is read once for all its files.
    for folder, paths in itertools.groupby(shard_paths(places), _folder_of):
        if folder is not None:
            yield from once.of(entries_of(folder, list(paths)))
            continue
        for path in paths:
            with open_shard(path) as shard:
                yield from once.of(EpisodeEntry.of(episode) for episode in shard)


def _folder_of(path: Path) -> Path | None:
    """The folder whose table has the episode of a file; None for a shard."""
    return path.parent if is_episode_file(path) else None


def episodes(
    places: Path | Sequence[Path], copies: bool = False
) -> Iterator[RecordedEpisode]:
    """Iterate over the episodes of shards and folders.

    Episodes remain usable after the iteration; once their file is closed, every access opens it again.

    Args:
        places: the shards and folders.
        copies: an episode may be in several shards. Otherwise that is an error: it would count more than once in every
            number, and no one could say which copy is meant.

    Raises:
        UsageError: an episode (config, seed and index) is in two shards, such as a file and its copy.
    """
    once = _Once(copies)
    for path in shard_paths(places):
        with open_shard(path) as shard:
            wanted = [name for name in shard.names if once.takes(path, name)]
            yield from map(shard.episode, wanted)


class _Once:
    """Decides which copy of an episode counts."""

    def __init__(self, copies: bool) -> None:
        self._copies = copies
        self._seen: dict[str, Path] = {}

    def of(self, found: Iterable[EpisodeEntry]) -> Iterator[EpisodeEntry]:
        """Those that count."""
        return (entry for entry in found if self.takes(entry.path, entry.name))

    def takes(self, path: Path, name: str) -> bool:
        """Whether an episode counts.

        Raises:
            UsageError: it is there twice, which is not allowed.
        """
        first = self._seen.setdefault(name, path)
        if first == path or self._copies:
            return True
        if is_leftover(path, first, name):
            return False
        raise UsageError(
            f"episode {name} is in {first} and in {path}. Leave one of them out, or write each episode "
            "once with: mjhab data merge PLACES --out NEW.h5"
        )


def is_leftover(path: Path, shard: Path, name: str) -> bool:
    """Whether a file is of an episode in a shard, left by a process that was killed before it deleted the file."""
    # Packing puts the shard beside the folder of the files.
    if not is_episode_file(path) or shard.parent != path.parent.parent:
        return False
    with open_shard(path) as one, open_shard(shard) as many:
        digests = {each.episode(name).attributes["digest"] for each in (one, many)}
    return len(digests) == 1
