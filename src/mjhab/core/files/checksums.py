"""Which files a published folder has, with sizes and hashes, and what differs from that."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mjhab.core.errors import fault
from mjhab.core.files.reading import read_json_object
from mjhab.core.names import below

Files = dict[str, dict[str, Any]]
"""Size [bytes] and SHA-256 of files by path: {"a/b.h5": {"bytes": 3, "sha256": "..."}}."""
KEY = "files"
"""Where the JSON file that describes a published folder lists its files."""
README = "README.md"
"""The card; its owner may edit it, so it is not listed."""


def list_files(root: Path, without: frozenset[str]) -> Files:
    """The files of a folder, but for the card, hidden ones and ``without`` (paths below ``root``)."""
    return {
        name: {"bytes": path.stat().st_size, "sha256": sha256_of(path)}
        for name, path in published(root)
        if name not in {README, *without}
    }


def published(root: Path) -> Iterator[tuple[str, Path]]:
    """Files of a folder that others get, in order, by path: none that is hidden, in a hidden folder, or a lock."""
    for path in sorted(root.rglob("*")):
        name = path.relative_to(root)
        if (
            # Locks lie beside files while they are written, and are deleted.
            path.suffix != ".lock"
            and path.is_file()
            and not any(part.startswith(".") for part in name.parts)
        ):
            yield name.as_posix(), path


def listed_in(describing: Path) -> Files:
    """The files that a JSON file lists under "files".

    Raises:
        UsageError: it cannot be read, lists none, or names a file outside of its folder.
    """
    files = read_json_object(describing).get(KEY)
    if not isinstance(files, Mapping) or not files:
        raise fault(describing, f"lists no {KEY}, so that nothing can be checked.")
    for name, what in files.items():
        fits = isinstance(what, Mapping) and type(what.get("bytes")) is int
        if not fits or not isinstance(what.get("sha256"), str):
            raise fault(describing, f"tells no bytes and sha256 of {str(name)[:80]!r}.")
        try:
            # A list from elsewhere must not make us read outside of its folder.
            below(describing.parent, name)
        except ValueError as error:
            raise fault(describing, str(error)) from error
    return {name: dict(what) for name, what in files.items()}


def differences(root: Path, files: Files) -> list[str]:
    """What differs between a folder and its list, one line each; empty if nothing does. Data that no list has count."""
    found = []
    for name, told in files.items():
        path = root / name
        if not path.is_file():
            found.append(f"{name} is missing")
        # The size first: it is free, and hashing takes seconds per GB.
        elif path.stat().st_size != told["bytes"]:
            found.append(f"{name} has {path.stat().st_size} bytes, not {told['bytes']}")
        elif sha256_of(path) != told["sha256"]:
            found.append(f"{name} has other content")
    known = {path.rpartition(".")[2] for path in files}
    for name, _ in published(root):
        if (
            name not in files
            and name != README
            # JSON may be the user's own notes; a further shard would be read as part of the data.
            and name.rpartition(".")[2] in known - {"json"}
        ):
            found.append(f"{name} is not listed")
    return found


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal digits."""
    with path.open("rb") as file:
        # Read in blocks: shards are larger than the memory of some machines.
        return hashlib.file_digest(file, "sha256").hexdigest()
