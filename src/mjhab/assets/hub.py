"""What a repository of the hub holds: its files with sizes and hashes, at one commit."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote, urlsplit

from mjhab.assets.archive import safe_path
from mjhab.assets.transfer import Expected, TransferError, get
from mjhab.core.errors import shown
from mjhab.core.files.reading import parse_json

MAX_PAGES = 1000
"""Most pages of a list of files; each has up to 1,000."""


@dataclass(frozen=True)
class RemoteFile:
    """A file of a repository: its path, its address and what it must be."""

    path: str
    url: str
    expected: Expected


def list_files(
    endpoint: str, repo: str, revision: str, sleep: Callable[[float], object]
) -> tuple[str, list[RemoteFile]]:
    """Commit of a revision, and the files of a data set's repository at that commit.

    Raises:
        TransferError: the hub has no such repository or revision, cannot be reached, or answers something else.
    """
    api = f"{endpoint}/api/datasets/{repo}"
    url = f"{api}/revision/{quote(revision, safe='')}"
    commit = _field(_json(get(url, sleep, first=True)[0], url), "sha", str, url)
    files: list[RemoteFile] = []
    tree = f"{api}/tree/{commit}"
    query = "recursive=true&expand=false"
    pages = 0
    while query:
        pages += 1
        if pages > MAX_PAGES:
            raise TransferError(
                f"{tree}: more than {MAX_PAGES} pages of files, which no data set has."
            )
        page = f"{tree}?{query}"
        body, link = get(page, sleep)
        rows = _json(body, page)
        if not isinstance(rows, list):
            raise TransferError(f"{page}: expected a list of files.")
        files += [
            _remote(row, f"{endpoint}/datasets/{repo}/resolve/{commit}", page)
            for row in rows
            if _is_file(row)
        ]
        query = _next_query(link)
    return commit, files


def _next_query(link: str) -> str:
    """Query of the next page. Only the query: a mirror may pass on links to the hub itself."""
    match = re.search(r'<([^>]+)>\s*;\s*rel="next"', link)
    return urlsplit(match[1]).query if match else ""


def _is_file(row: Any) -> bool:
    return isinstance(row, dict) and row.get("type") == "file"


def _remote(row: dict[str, Any], base: str, page: str) -> RemoteFile:
    path = safe_path(_field(row, "path", str, page), page)
    lfs = row.get("lfs") or {}
    big = isinstance(lfs, dict) and "oid" in lfs
    size = _field(lfs if big else row, "size", int, page)
    if size < 0:
        raise TransferError(f"{page}: {path} has {size} bytes.")
    # A pointer's own hash says nothing about the file behind it.
    expected = (
        Expected(size, sha256=str(lfs["oid"]))
        if big
        else Expected(size, blob_sha1=str(row.get("oid", "")))
    )
    return RemoteFile(path, f"{base}/{quote(path)}", expected)


def _field(row: Any, name: str, kind: type, where: str) -> Any:
    value = row.get(name) if isinstance(row, dict) else None
    if not isinstance(value, kind) or isinstance(value, bool):
        raise TransferError(
            f"{where}: field {name!r} must be {kind.__name__}, got {shown(value)}."
        )
    return value


def _json(body: bytes, url: str) -> Any:
    try:
        return parse_json(body)
    except ValueError as error:
        raise TransferError(
            f"{url}: the answer is not JSON; is HF_ENDPOINT the address of a hub?"
        ) from error
