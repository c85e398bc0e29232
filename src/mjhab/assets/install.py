"""Data sets below the assets folder: fetched or unpacked beside their place, checked, and put there by one rename.

The folder of a data set holds a record of its files with their SHA-256. Work in progress lies below ``.partial`` and
is continued by the next run.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import threading
import time
from collections.abc import Callable
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from mjhab.assets.archive import safe_path, unpack
from mjhab.assets.hub import RemoteFile, list_files
from mjhab.assets.sources import Source, hub_endpoint
from mjhab.assets.transfer import download
from mjhab.core.errors import UsageError
from mjhab.core.files.cache import write_atomic
from mjhab.core.files.reading import parse_json

RECORD = ".mjhab-asset.json"
FORMAT = "mjhab-asset-1"
PARTIAL = ".partial"
CONNECTIONS = 4
_DEPTH = 3
"""Folders that an archive may put around the data set."""


@dataclass(frozen=True)
class Progress:
    """Whom to tell: ``total`` (bytes that will come, known once listed), ``step`` (bytes that came or went)."""

    total: Callable[[int], object] = lambda count: None
    step: Callable[[int], object] = lambda count: None
    sleep: Callable[[float], object] = time.sleep
    """How to wait before another try."""


@dataclass(frozen=True)
class Verification:
    """Result of a check: paths that are ``missing`` or ``changed``; ``first_use``: no record was there, it is now."""

    files: int
    missing: tuple[str, ...]
    changed: tuple[str, ...]
    first_use: bool


def fetch(
    source: Source, root: Path, overwrite: bool = False, progress: Progress | None = None
) -> Path:
    """Download a data set from the hub and install it as ``root/<name>``; an interrupted run is continued.

    Args:
        source: the data set.
        root: the assets folder.
        overwrite: replace an installed one.
        progress: whom to tell.

    Raises:
        UsageError: it is installed already, there is no room, or the repository lacks what the readers need.
        TransferError: the network did not give it.
    """
    progress = progress or Progress()
    _refuse_installed(root / source.name, overwrite)
    commit, listed = list_files(
        hub_endpoint(), source.repo, source.revision, progress.sleep
    )
    wanted = _wanted(source, listed)
    staging = root / PARTIAL / f"{source.name}-{commit[:12]}"
    staging.mkdir(parents=True, exist_ok=True)
    total = sum(file.expected.size or 0 for _, file in wanted)
    _room(staging, total)
    progress.total(total)
    hashes = _download_all(wanted, staging, progress)
    told = {
        "origin": source.repo,
        "revision": source.revision,
        "commit": commit,
        "trust": "hub",
    }
    if source.archive:
        content = staging.with_name(staging.name + "-unpacked")
        shutil.rmtree(content, ignore_errors=True)
        told["archive_sha256"] = hashes[source.archive]
        try:
            unpack(staging / source.archive, content)
            _install(source, content, root, told)
        finally:
            shutil.rmtree(content, ignore_errors=True)
    else:
        _install(source, staging, root, told)
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
        raise UsageError(f"--offline {bundle}: there is no such file.")
    _refuse_installed(root / source.name, overwrite)
    content = root / PARTIAL / f"{source.name}-bundle-{os.getpid()}"
    try:
        unpack(bundle, content)
        _install(source, content, root, {"origin": bundle.name, "trust": "first use"})
    finally:
        shutil.rmtree(content, ignore_errors=True)
    return root / source.name


def verify(folder: Path) -> Verification:
    """Compare an installed data set with its record; without one, write it: the files are trusted on first use.

    Raises:
        UsageError: there is no such folder, or its record cannot be read.
    """
    if not folder.is_dir():
        raise UsageError(
            f"{folder} does not exist; `mjhab assets fetch {folder.name}` gets it."
        )
    record = read_record(folder)
    if record is None:
        files = _digests(folder)
        _write_record(folder, {"origin": str(folder), "trust": "first use"}, files)
        return Verification(len(files), (), (), True)
    listed: dict[str, dict[str, Any]] = record["files"]
    missing = tuple(sorted(path for path in listed if not (folder / path).is_file()))
    there = [path for path in listed if (folder / path).is_file()]
    changed = tuple(
        sorted(path for path in there if _sha256(folder / path) != listed[path]["sha256"])
    )
    return Verification(len(listed), missing, changed, False)


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
        raise UsageError(
            f"{path}: damaged ({error}); download the data set again with --overwrite."
        ) from error
    return body


def _refuse_installed(target: Path, overwrite: bool) -> None:
    if target.exists() and not overwrite:
        raise UsageError(
            f"{target} exists; `mjhab assets verify {target.name}` checks it, --overwrite replaces it."
        )


def _room(folder: Path, total: int) -> None:
    have = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    free = shutil.disk_usage(folder).free
    if total - have > free:
        raise UsageError(
            f"{folder} needs {(total - have) / 1e9:.1f} GB more, but only {free / 1e9:.1f} GB are free."
        )


def _wanted(source: Source, listed: list[RemoteFile]) -> list[tuple[str, RemoteFile]]:
    """Files to download, each with its place.

    Raises:
        UsageError: the repository has none of them.
    """
    if source.archive:
        placed = [
            (source.archive, file) for file in listed if file.path == source.archive
        ]
    else:
        placed = [
            (to, file) for file in listed if (to := source.place(file.path)) is not None
        ]
    if not placed:
        raise UsageError(
            f"{source.repo} at {source.revision} has {len(listed)} files, but none that {source.name} is made of; "
            "it may have changed: name another with --repo and --revision, or install an archive with --offline."
        )
    return [(safe_path(to, source.repo), file) for to, file in placed]


def _download_all(
    wanted: list[tuple[str, RemoteFile]], staging: Path, progress: Progress
) -> dict[str, str]:
    """Download several files at once. A file under its own name is whole and was checked. Returns new files' hashes."""
    stop = threading.Event()

    def one(item: tuple[str, RemoteFile]) -> tuple[str, str]:
        to, file = item
        target = staging / to
        if target.is_file() and target.stat().st_size == file.expected.size:
            progress.step(target.stat().st_size)
            return to, _sha256(target)
        return to, download(
            file.url, target, file.expected, progress.step, stop, progress.sleep
        )

    pool = ThreadPoolExecutor(CONNECTIONS)
    try:
        futures = [pool.submit(one, item) for item in wanted]
        done, _ = wait(futures, return_when=FIRST_EXCEPTION)
        for future in done:
            future.result()
        return dict(future.result() for future in futures)
    finally:
        stop.set()
        pool.shutdown(wait=True, cancel_futures=True)


def _install(source: Source, content: Path, root: Path, told: dict[str, str]) -> None:
    """Record the files of a data set found in ``content`` and move it to its place.

    Raises:
        UsageError: ``content`` does not hold the data set.
    """
    found = _find(source, content)
    if found is None:
        needed = ", ".join(source.expects)
        raise UsageError(
            f"{told['origin']} is not the data set {source.name}: it must hold {needed}."
        )
    _write_record(found, told, _digests(found))
    _swap(found, root / source.name, root / PARTIAL)


def _find(source: Source, content: Path) -> Path | None:
    """The folder in ``content`` that is the data set, or one made of its files if they lie as in the repository."""
    level = [content]
    for _ in range(_DEPTH):
        for folder in level:
            found = folder if source.complete(folder) else _arranged(source, folder)
            if found is not None:
                return found
        level = [
            child
            for folder in level
            for child in sorted(folder.iterdir())
            if child.is_dir()
        ]
    return None


def _arranged(source: Source, folder: Path) -> Path | None:
    """Files of a repository's layout, moved to where the readers look; None if this is not that layout."""
    if not source.picks:
        return None
    paths = {
        path: source.place(path.relative_to(folder).as_posix())
        for path in folder.rglob("*")
        if path.is_file()
    }
    moves = {path: to for path, to in paths.items() if to is not None}
    if not all(
        any(fnmatch(to, pattern) for to in moves.values()) for pattern in source.expects
    ):
        return None
    placed = folder / PARTIAL
    for path, to in moves.items():
        (placed / to).parent.mkdir(parents=True, exist_ok=True)
        path.rename(placed / to)
    return placed


def _swap(new: Path, target: Path, partial: Path) -> None:
    """Put ``new`` at ``target``; an old folder there is kept until the new one is in place."""
    target.parent.mkdir(parents=True, exist_ok=True)
    old = partial / f"{target.name}-old-{os.getpid()}"
    if target.exists():
        shutil.rmtree(old, ignore_errors=True)
        target.rename(old)
    try:
        new.rename(target)
    except OSError:
        if old.exists():
            old.rename(target)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _digests(folder: Path) -> dict[str, dict[str, Any]]:
    files = [
        path
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != RECORD
    ]
    return {
        path.relative_to(folder).as_posix(): {
            "size": path.stat().st_size,
            "sha256": _sha256(path),
        }
        for path in files
    }


def _write_record(
    folder: Path, told: dict[str, str], files: dict[str, dict[str, Any]]
) -> None:
    body = json.dumps({"format": FORMAT, **told, "files": files}, indent=1)
    write_atomic(
        folder / RECORD, lambda temporary: temporary.write_text(body, encoding="utf-8")
    )


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
