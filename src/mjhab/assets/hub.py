"""A repository on the hub: what it holds at one commit, and its download by `huggingface_hub`.

The library fetches several files at once, continues cut connections, and honours proxies, tokens and Xet. Two things
are ours, as of its version 2.4: it compares sizes alone with what the hub lists (one turned bit is installed; without
our comparison `test_wrong_bytes_are_thrown_away` fails), and its errors are paragraphs about models, here one line.
A run that ends in the middle of a file begins that file anew: the library gives each download a name of its own and
deletes it at the end (``file_download._download_to_tmp_and_move``), and has no setting for it.
"""

from __future__ import annotations

import functools
import glob
import hashlib
import sys
import threading
import time
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from mjhab.assets.archive import safe_path
from mjhab.assets.sources import hub_endpoint
from mjhab.core.errors import MjhabError, UsageError, wrong_value
from mjhab.core.files.reading import reason
from mjhab.core.version import __version__

TIMEOUT_S = 10.0
"""Longest silence of the hub before it names the files [s]; the library's own for files is as long."""
TRIES = 3
"""Times that the hub is asked while it is busy or sends wrong bytes; cut connections are up to the library."""
_PASSING = (408, 425, 429, 500, 502, 503, 504)
"""HTTP states that pass by themselves."""
_BELOW = ("httpx2", "httpx")
"""Library of connections of `huggingface_hub` 2, and of 1, which LeRobot 0.6 needs."""
_HINTS = {
    401: ": it is private, or not there",
    403: ": it is not public",
    404: ": it is not there",
}
_OF_NO_HUB = (ValueError, KeyError, TypeError, AttributeError, RecursionError)
"""What the library raises for answers that it cannot read."""
_KEPT = "Finished files stay, and the same command continues."
Answer = TypeVar("Answer")


class TransferError(MjhabError):
    """A download did not come about; finished files are kept for the next try.

    ``what``: address or file. ``problem``: what is wrong with it. ``status``: of HTTP, None without an answer.
    ``passes``: whether another try may help.
    """

    def __init__(
        self, what: str, problem: str, status: int | None = None, passes: bool = False
    ) -> None:
        super().__init__(f"{what}: {problem}")
        self.what = what
        self.problem = problem
        self.status = status
        self.passes = passes


@dataclass(frozen=True)
class RemoteFile:
    """What a file must be: its size [bytes], and its SHA-256 or git's SHA-1 of it as a blob, as the hub lists it."""

    size: int
    sha256: str
    blob_sha1: str

    def matches(self, path: Path) -> bool:
        """Whether a file is there with these bytes."""
        # The size first: hashing GB to find a cut file takes minutes.
        if not path.is_file() or path.stat().st_size != self.size:
            return False
        with path.open("rb") as file:
            if self.sha256:
                return hashlib.file_digest(file, "sha256").hexdigest() == self.sha256
            # How git hashes a file; the hub lists no other hash of small ones.
            blob = hashlib.sha1(b"blob %d\0" % self.size, usedforsecurity=False)
            blob.update(file.read())
            return blob.hexdigest() == self.blob_sha1


@dataclass(frozen=True)
class Repository:
    """The files of a repository at one commit, by path. kind: "dataset" or "model"."""

    name: str
    commit: str
    files: Mapping[str, RemoteFile]
    kind: str = "dataset"

    @property
    def address(self) -> str:
        """Where a browser finds it."""
        return address_of(self.name, self.kind)


def address_of(name: str, kind: str) -> str:
    """Where a browser finds a repository."""
    return f"{hub_endpoint()}/{'datasets/' if kind == 'dataset' else ''}{name}"


def check_repository(name: str) -> None:
    """Refuse a name that no repository can have.

    Raises:
        UsageError: it is none.
    """
    from huggingface_hub.errors import HFValidationError
    from huggingface_hub.utils import validate_repo_id

    try:
        validate_repo_id(name)
    except HFValidationError as error:
        raise wrong_value("repo", name, f"a repository ({reason(error)})") from error


def list_files(name: str, revision: str, kind: str = "dataset") -> Repository:
    """The files of a repository at the commit that a revision names now.

    Raises:
        UsageError: ``name`` is none that a repository can have, or a path leads out of the folder.
        TransferError: the hub has no such repository or revision, cannot be reached, or answers something else.
    """
    from huggingface_hub import HfApi
    from huggingface_hub.utils import logging

    check_repository(name)
    logging.set_verbosity_error()
    where = address_of(name, kind)
    api = HfApi(hub_endpoint(), library_name="mjhab", library_version=__version__)

    def ask() -> Repository:
        info = api.repo_info(
            name,
            revision=revision,
            repo_type=kind,
            files_metadata=True,
            timeout=TIMEOUT_S,
        )
        if not isinstance(info.sha, str):
            raise ValueError("it names no commit")
        rows = getattr(info, "siblings", None) or []
        files = {safe_path(row.rfilename, where): _remote(row) for row in rows}
        return Repository(name, info.sha, files, kind)

    return patiently(ask, where)


def _remote(row: Any) -> RemoteFile:
    # A pointer's own size and hash say nothing about the file behind it.
    if row.lfs is not None:
        return RemoteFile(int(row.lfs.size), str(row.lfs.sha256), "")
    return RemoteFile(int(row.size), "", str(row.blob_id))


def download(repository: Repository, paths: Collection[str], folder: Path) -> None:
    """Bring files into a folder; those that are there with the right bytes stay.

    Raises:
        TransferError: the hub does not give a file, or gives another one than it lists.
    """
    from huggingface_hub import snapshot_download
    from huggingface_hub.utils import disable_progress_bars, tqdm

    if not sys.stderr.isatty():
        # In a log file a bar would write a line at every step.
        disable_progress_bars()
    stop = threading.Event()

    class Bar(tqdm):
        """The library's bar; by it transfers hear of Ctrl-C: the library would finish the files that it has begun."""

        def update(self, n: float | None = 1) -> bool | None:
            if stop.is_set():
                raise TransferError(repository.name, f"interrupted. {_KEPT}")
            return super().update(n)

    is_whole = len(paths) == len(repository.files)

    def ask() -> None:
        bring = functools.partial(
            snapshot_download,
            repository.name,
            repo_type=repository.kind,
            revision=repository.commit,
            endpoint=hub_endpoint(),
            local_dir=folder,
            # Paths with brackets would be patterns.
            allow_patterns=None if is_whole else [glob.escape(path) for path in paths],
            tqdm_class=Bar,
        )
        # The main thread stays free to hear Ctrl-C, which Python gives to it alone.
        with ThreadPoolExecutor(1) as thread:
            try:
                thread.submit(bring).result()
            except KeyboardInterrupt:
                stop.set()
                raise
        wrong = [p for p in paths if not repository.files[p].matches(folder / p)]
        for path in wrong:
            # Otherwise the library would take the file for finished in the next try.
            (folder / path).unlink(missing_ok=True)
        if wrong:
            raise TransferError(
                f"{repository.name}/{wrong[0]}",
                "the server sent other bytes than the hub lists, again and again.",
                passes=True,
            )

    patiently(ask, repository.address)


def patiently(ask: Callable[[], Answer], what: str) -> Answer:
    """What ``ask`` returns, asked again after failures that pass.

    Raises:
        UsageError: as ``ask`` does.
        TransferError: anything else fails for good.
    """
    for attempt in range(1, TRIES + 1):
        try:
            return ask()
        # Asking again would give the same.
        except UsageError:
            raise
        except Exception as error:
            failure = _transfer_error(what, error)
            if attempt == TRIES or not failure.passes:
                raise failure from error
        # Longer each time: a server that is busy needs fewer requests, not more.
        time.sleep(2.0**attempt)
    raise AssertionError("the last try returns or raises")


def _is_of_connection(error: BaseException) -> bool:
    """Whether the library below `huggingface_hub` raised an error."""
    return any(
        # By name, because importing the library would tie us to its version.
        kind.__name__ == "HTTPError" and kind.__module__.partition(".")[0] in _BELOW
        for kind in type(error).__mro__
    )


def _transfer_error(what: str, error: BaseException) -> TransferError:
    """An error of the library in one line."""
    from huggingface_hub.errors import (
        FileMetadataError,
        HfHubHTTPError,
        LocalEntryNotFoundError,
        OfflineModeIsEnabled,
    )

    if isinstance(error, TransferError):
        return error
    if isinstance(error, LocalEntryNotFoundError) and error.__cause__ is not None:
        return _transfer_error(what, error.__cause__)
    if isinstance(error, OfflineModeIsEnabled):
        return TransferError(
            what, "HF_HUB_OFFLINE forbids the network; unset it, or give --offline."
        )
    if isinstance(error, HfHubHTTPError):
        status = error.response.status_code
        says = f"{status} {error.response.reason_phrase}{_HINTS.get(status, '')}"
        where = str(error.response.url)
        return TransferError(
            where, f"the server says {says}.", status, status in _PASSING
        )
    if _is_of_connection(error):
        said = reason(error) if str(error) else type(error).__name__
        advice = f"is there a network? A proxy is named by https_proxy. {_KEPT}"
        return TransferError(what, f"the connection failed ({said}): {advice}")
    if isinstance(error, (FileMetadataError, *_OF_NO_HUB)):
        advice = "is HF_ENDPOINT the address of one?"
        return TransferError(
            what, f"the answer is not that of a hub ({reason(error)}); {advice}"
        )
    # The disk, and what Xet says.
    return TransferError(what, f"{reason(error)}. {_KEPT}")
