"""Data sets below the assets folder: fetched or unpacked beside their place, checked, and put there by one rename.

The folder of a data set holds a record of its files with their SHA-256. Work in progress lies below ``.partial`` and
is continued by the next run.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from mjhab.assets.archive import safe_path, unpack
from mjhab.assets.hub import Repository, download, list_files
from mjhab.assets.sources import Source
from mjhab.core.errors import fault
from mjhab.core.files.cache import write_text
from mjhab.core.files.locking import WriteLock
from mjhab.core.files.reading import parse_json

RECORD = ".mjhab-asset.json"
FORMAT = "mjhab-asset-1"
PARTIAL = ".partial"


@dataclass(frozen=True)
class Verification:
    """Result of a check: paths that are ``missing`` or ``changed``; ``first_use``: no record was there, it is now."""

    files: int
    missing: tuple[str, ...]
    changed: tuple[str, ...]
    first_use: bool


def fetch(source: Source, root: Path, overwrite: bool = False) -> Path:
    """Download a data set from the hub and install it as ``root/<name>``; an interrupted run is continued.

    Args:
        source: the data set.
        root: the assets folder.
        overwrite: replace an installed one.

    Raises:
        UsageError: it is installed already, there is no room, another process installs it, or the repository lacks
            what the readers need.
        TransferError: the network did not give it.
    """
    with _work_folder(source, root, overwrite) as content:
        repository = list_files(source.repo, source.revision)
        places = _places(source, repository)
        provenance = {
            "origin": source.repo,
            "revision": source.revision,
            "commit": repository.commit,
            "trust": "hub",
        }
        # By the commit: files of another one must not be mixed in when a download goes on.
        staging = root / PARTIAL / f"{source.name}-{repository.commit[:12]}"
        staging.mkdir(exist_ok=True)
        _refuse_without_room(staging, sum(repository.files[path].size for path in places))
        download(repository, places, staging)
        if source.archive:
            provenance["archive_sha256"] = _sha256(staging / source.archive)
            unpack(staging / source.archive, content)
        else:
            _move({staging / path: to for path, to in places.items()}, content)
        _install(source, content, root, provenance)
        # Stages of older commits as well.
        for left in (root / PARTIAL).glob(f"{source.name}-*"):
            shutil.rmtree(left, ignore_errors=True)
    return root / source.name


def install_bundle(
    source: Source, bundle: Path, root: Path, overwrite: bool = False
) -> Path:
    """Install a data set from an archive on this machine; no network is used.

    Raises:
        UsageError: it is installed already, or the archive is no such data set, damaged or dangerous.
    """
    if not bundle.is_file():
        raise fault(bundle, "does not exist.")
    with _work_folder(source, root, overwrite) as content:
        unpack(bundle, content)
        _install(source, content, root, {"origin": bundle.name, "trust": "first use"})
    return root / source.name


def verify(folder: Path) -> Verification:
    """Compare an installed data set with its record; without one, write it: the files are trusted on first use.

    Raises:
        UsageError: there is no such folder, or its record cannot be read.
    """
    if not folder.is_dir():
        raise fault(
            folder, f"does not exist; `mjhab assets fetch {folder.name}` gets it."
        )
    record = read_record(folder)
    if record is None:
        files = _write_record(folder, {"origin": str(folder), "trust": "first use"})
        return Verification(len(files), (), (), True)
    listed: dict[str, dict[str, Any]] = record["files"]
    missing = sorted(path for path in listed if not (folder / path).is_file())
    there = sorted(listed.keys() - set(missing))
    changed = [path for path in there if _sha256(folder / path) != listed[path]["sha256"]]
    return Verification(len(listed), tuple(missing), tuple(changed), False)


def read_record(folder: Path) -> dict[str, Any] | None:
    """The record of an installed data set, None if there is none.

    Raises:
        UsageError: the file is damaged.
    """
    path = folder / RECORD
    if not path.is_file():
        return None
    try:
        body = parse_json(path.read_bytes())
        if body["format"] != FORMAT:
            raise ValueError(f"field 'format' must be {FORMAT!r}")
        for name, row in body["files"].items():
            safe_path(name, str(path))
            if not isinstance(row["sha256"], str):
                raise ValueError(f"files[{name!r}].sha256 must be a string")
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise fault(
            path, f"damaged ({error}); download the data set again with --overwrite."
        ) from error
    return body


def _refuse_without_room(folder: Path, total: int) -> None:
    have = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    free = shutil.disk_usage(folder).free
    if total - have > free:
        raise fault(
            folder,
            f"needs {(total - have) / 1e9:.1f} GB more, but only {free / 1e9:.1f} GB are free.",
        )


def _places(source: Source, repository: Repository) -> dict[str, str]:
    """Files to download, each with its place in the installed folder.

    Raises:
        UsageError: the repository has none of them.
    """
    places = {
        path: to for path in repository.files if (to := source.place(path)) is not None
    }
    if not places:
        raise fault(
            source.repo,
            f"at {source.revision} has {len(repository.files)} files, but none that {source.name} is "
            "made of; it may have changed: name another with --repo and --revision, or give an archive with --offline.",
        )
    return places


@contextmanager
def _work_folder(source: Source, root: Path, overwrite: bool) -> Iterator[Path]:
    """A path below ``.partial`` for what will be installed; nothing is left there, and nobody else installs meanwhile.

    Raises:
        UsageError: it is installed already and may not be replaced, or another process installs it.
    """
    target = root / source.name
    if target.exists() and not overwrite:
        raise fault(
            target,
            f"exists; `mjhab assets verify {target.name}` checks it, --overwrite replaces it.",
        )
    content = root / PARTIAL / f"{source.name}-content"
    content.parent.mkdir(parents=True, exist_ok=True)
    with WriteLock(root / PARTIAL / source.name, target):
        shutil.rmtree(content, ignore_errors=True)  # of a killed process
        try:
            yield content
        finally:
            shutil.rmtree(content, ignore_errors=True)


def _install(
    source: Source, content: Path, root: Path, provenance: dict[str, str]
) -> None:
    """Record the files of a data set found in ``content`` and move it to its place.

    Raises:
        UsageError: ``content`` does not hold the data set.
    """
    found = _find(source, content)
    if found is None:
        needed = ", ".join(source.expects)
        raise fault(
            provenance["origin"],
            f"not the data set {source.name}: it must hold {needed}.",
        )
    _write_record(found, provenance)
    _swap(found, root / source.name, root / PARTIAL / f"{source.name}-old")


def _find(source: Source, content: Path) -> Path | None:
    """The folder in ``content`` that is the data set, or one made of its files if they lie as in the repository."""
    # Archives have their files in one or two folders of their own; the outermost that fits is taken.
    for wrapped in ("", "*/", "*/*/"):
        for folder in sorted(content.glob(wrapped)) if wrapped else [content]:
            found = folder if source.complete(folder) else _arranged(source, folder)
            if found is not None:
                return found
    return None


def _arranged(source: Source, folder: Path) -> Path | None:
    """Files of a repository's layout, moved to where the readers look; None if this is not that layout."""
    if not source.picks:
        return None
    moves = {
        path: to
        for path in folder.rglob("*")
        if path.is_file()
        and (to := source.place(path.relative_to(folder).as_posix())) is not None
    }
    places = moves.values()
    if not all(any(fnmatch(to, wanted) for to in places) for wanted in source.expects):
        return None
    _move(moves, folder / PARTIAL)
    return folder / PARTIAL


def _move(moves: dict[Path, str], folder: Path) -> None:
    """Move files, each to its place below a folder."""
    for path, to in moves.items():
        (folder / to).parent.mkdir(parents=True, exist_ok=True)
        path.rename(folder / to)


def _swap(new: Path, target: Path, old: Path) -> None:
    """Put ``new`` at ``target``; a folder that was there is kept as ``old`` until the new one is in place."""
    if target.exists():
        shutil.rmtree(old, ignore_errors=True)
        # A folder with files cannot be replaced by rename.
        target.rename(old)
    try:
        new.rename(target)
    except OSError:
        if old.exists():
            # The new folder did not arrive, and the old one is whole.
            old.rename(target)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _write_record(folder: Path, provenance: dict[str, str]) -> dict[str, dict[str, Any]]:
    """Write the record of a folder; returns size and SHA-256 of its files by path."""
    paths = (path for path in sorted(folder.rglob("*")) if path.is_file())
    files = {
        path.relative_to(folder).as_posix(): {
            "size": path.stat().st_size,
            "sha256": _sha256(path),
        }
        for path in paths
        if path.name != RECORD
    }
    body = json.dumps({"format": FORMAT, **provenance, "files": files}, indent=1)
    write_text(folder / RECORD, body)
    return files


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
