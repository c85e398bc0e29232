"""The shards in files and folders, and the episodes in them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from mjhab.core.errors import UsageError
from mjhab.data.store.reading import RecordedEpisode, open_shard


def shard_paths(places: Path | Sequence[Path]) -> list[Path]:
    """Shards among the given files and, recursively, in the given folders; sorted by name within a folder. A file that
    is named twice, or by a link, too, is there once.

    Raises:
        UsageError: no place is given, a place does not exist, or a folder has no shards.
    """
    if not isinstance(places, Path) and not places:
        raise UsageError("name shards (*.h5), or folders of shards.")
    found: list[Path] = []
    for place in [places] if isinstance(places, Path) else places:
        if place.is_dir():
            inside = sorted(
                path for path in place.rglob("*.h5") if not path.name.startswith(".")
            )
            if not inside:
                raise UsageError(f"no shards (*.h5) in {place} or the folders in it.")
            found += inside
        elif place.is_file():
            found.append(place)
        else:
            raise UsageError(
                f"{place} does not exist; give a shard (*.h5) or a folder of shards."
            )
    by_file: dict[Path, Path] = {}
    for path in found:
        by_file.setdefault(path.resolve(), path)
    return list(by_file.values())


def episodes(
    places: Path | Sequence[Path], copies: bool = False
) -> Iterator[RecordedEpisode]:
    """Iterate over the episodes of shards and folders.

    Episodes remain usable after the iteration; once their shard is closed, every access opens the file again.

    Args:
        places: the shards and folders.
        copies: an episode may be in several shards. Otherwise that is an error: it would count more than once in every
            number, and no one could say which copy is meant.

    Raises:
        UsageError: an episode (config, seed and index) is in two shards, such as a file and its copy.
    """
    seen: dict[str, Path] = {}
    for path in shard_paths(places):
        with open_shard(path) as shard:
            for name in shard.names:
                first = seen.setdefault(name, path)
                if first != path and not copies:
                    raise UsageError(
                        f"episode {name} is in {first} and in {path}. Leave one of them out, or write each episode "
                        "once with: mjhab data merge PLACES --out NEW.h5"
                    )
            yield from shard
