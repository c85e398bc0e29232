"""HTTP with the standard library: retries, resumed downloads, checksums.

``urllib`` and not a client library: it is always there, follows redirects with the Range header, and honours the proxy
variables (``http_proxy``, ``https_proxy``, ``no_proxy``).
"""

from __future__ import annotations

import errno
import hashlib
import http.client
import re
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO
from urllib.error import HTTPError, URLError
from urllib.request import Request, build_opener

from mjhab.core.errors import MjhabError
from mjhab.core.files.reading import one_line
from mjhab.core.version import __version__

TRIES = 6
"""Tries in a row that bring nothing new before a transfer is given up."""
WRONG_COSTS = 3
"""A whole file with wrong bytes counts as so many tries: it may be large."""
SILENCE_COSTS = 3
"""A server that says nothing at all for so long counts as so many tries: it has nothing to say."""
TIMEOUT = 30.0
"""Longest silence of a server [s]."""
FIRST_TIMEOUT = 4.0
"""Longest wait for the first answer of all [s]: without a network nobody should wait long to hear so."""
MAX_DOCUMENT_MB = 64
"""Largest document that is not written to a file [MB]; a list of 1,000 files takes about 0.3."""
MAX_DOCUMENT_S = 60.0
"""Longest time that such a document may take [s]."""
UNREACHED_TRIES = 2
"""Tries in a row in which no server was reached at all before that is told."""
CHUNK = 1 << 18
_SILENT = "the server says nothing"
_PASSING = (408, 425, 429, 500, 502, 503, 504)
"""HTTP states that pass by themselves."""
_OF_THE_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG)
"""Numbers of errors of the disk, which do not pass."""


class TransferError(MjhabError):
    """A download did not come about; what has arrived is kept for the next try."""


@dataclass(frozen=True)
class Expected:
    """What a file must be, as far as the hub tells: ``size`` [bytes], its SHA-256, or git's SHA-1 of it as a blob."""

    size: int | None = None
    sha256: str = ""
    blob_sha1: str = ""


def pause(attempt: int) -> float:
    """Seconds to wait before another try."""
    return min(2.0**attempt, 30.0)


def get(
    url: str, sleep: Callable[[float], object] = time.sleep, first: bool = False
) -> tuple[bytes, str]:
    """Body and ``Link`` header of a small document.

    Args:
        url: its address.
        sleep: waits between tries.
        first: whether this server has not answered anything yet; it is then given less time.

    Raises:
        TransferError: the server does not give it.
    """
    problem = ""
    attempt = 0
    while attempt < TRIES:
        try:
            with _open(url, timeout=FIRST_TIMEOUT if first else TIMEOUT) as answer:
                return _document(url, answer), answer.headers.get("Link", "")
        except (OSError, http.client.HTTPException, ValueError) as error:
            problem = _worth_another_try(url, error)
            if _is_unreached(error) and (
                _is_silent(error) or attempt + 1 >= UNREACHED_TRIES
            ):
                raise TransferError(
                    f"{url}: {problem}. No server can be reached: is there a network? A proxy is named by https_proxy. "
                    "What was fetched before stays, and the same command continues."
                ) from error
            if isinstance(error, TimeoutError):
                # The wait was long enough.
                attempt += SILENCE_COSTS
                continue
        sleep(pause(attempt))
        attempt += 1
    raise TransferError(
        f"{url}: {problem}, again and again; check the network or the proxy and try again."
    )


def _document(url: str, answer: http.client.HTTPResponse) -> bytes:
    """The body of an answer.

    Raises:
        TransferError: it takes longer than `MAX_DOCUMENT_S` or is larger than `MAX_DOCUMENT_MB`.
    """
    began = time.monotonic()
    body = bytearray()
    while chunk := answer.read1(CHUNK):
        body += chunk
        if len(body) > MAX_DOCUMENT_MB * 2**20:
            raise TransferError(f"{url}: the answer is larger than {MAX_DOCUMENT_MB} MB.")
        if time.monotonic() - began > MAX_DOCUMENT_S:
            raise TransferError(
                f"{url}: the answer took longer than {MAX_DOCUMENT_S:g} s."
            )
    return bytes(body)


def download(
    url: str,
    target: Path,
    expected: Expected,
    tell: Callable[[int], object] = lambda count: None,
    stop: threading.Event | None = None,
    sleep: Callable[[float], object] = time.sleep,
) -> str:
    """Download one file and return its SHA-256; a cut connection continues where it broke off, also in a later run.

    Args:
        url, target: address, and the file; until it is whole and right, its bytes are in ``<target>.part``.
        expected: what it must be.
        tell: called with the number of new bytes, negative when bytes had to be thrown away.
        stop: when set, the transfer ends early; sleep: waits between tries.

    Raises:
        TransferError: the server does not give the file, or gives another one.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(target.name + ".part")
    tell(_size(part))
    failures = 0
    problem = ""
    while failures < TRIES:
        before = _size(part)
        if expected.size is None or before != expected.size:
            problem = _append(url, part, expected, tell, stop)
        if not problem:
            problem, digest = _wrong(part, expected)
            if not problem:
                part.replace(target)
                return digest
            tell(-_size(part))
            part.unlink()
            failures += WRONG_COSTS - 1
        if problem == _SILENT:
            failures += SILENCE_COSTS - 1
        failures = 0 if _size(part) > before else failures + 1
        if stop is not None and stop.is_set():
            raise TransferError("interrupted")
        if 0 < failures < TRIES:
            sleep(pause(failures - 1))
    raise TransferError(
        f"{url}: {problem}, again and again; the same command continues from what has arrived."
    )


def _append(
    url: str,
    part: Path,
    expected: Expected,
    tell: Callable[[int], object],
    stop: threading.Event | None,
) -> str:
    """Add what the server sends to ``part``; returns what went wrong, or nothing when the file is whole."""
    have = _size(part)
    if expected.size is not None and have > expected.size:
        tell(-have)
        part.unlink()
        have = 0
    try:
        with _open(url, have) as answer:
            if have and not _continues(
                answer, have
            ):  # the server knows no ranges and sends the whole file
                tell(-have)
                have = 0
            with part.open("ab" if have else "wb") as file:
                total = have + _copy(answer, file, tell, stop)
            length = answer.headers.get("Content-Length")
    except HTTPError as error:
        if error.code == 416:  # our bytes are not part of what the server has
            tell(-_size(part))
            part.unlink(missing_ok=True)
            return "the server refused to continue"
        return _worth_another_try(url, error)
    except TimeoutError:
        return _SILENT
    except (OSError, http.client.HTTPException, ValueError) as error:
        if isinstance(error, OSError) and error.errno in _OF_THE_DISK:
            raise TransferError(
                f"{part} cannot be written: {error.strerror}; the same command continues from what has arrived."
            ) from error
        return _worth_another_try(url, error)
    wanted = (
        expected.size
        if expected.size is not None
        else (have + int(length) if length else total)
    )
    return (
        ""
        if total >= wanted
        else f"the connection broke off at {total} of {wanted} bytes"
    )


def _copy(
    answer: IO[bytes],
    file: IO[bytes],
    tell: Callable[[int], object],
    stop: threading.Event | None,
) -> int:
    count = 0
    while chunk := answer.read(CHUNK):
        file.write(chunk)
        count += len(chunk)
        tell(len(chunk))
        if stop is not None and stop.is_set():
            raise TransferError("interrupted")
    return count


def _continues(answer: http.client.HTTPResponse, have: int) -> bool:
    """Whether the answer goes on at byte ``have``."""
    match = re.match(r"bytes (\d+)-", answer.headers.get("Content-Range", ""))
    return answer.status == 206 and match is not None and int(match[1]) == have


def _wrong(part: Path, expected: Expected) -> tuple[str, str]:
    """What is wrong with the whole file, or nothing; and its SHA-256."""
    size = _size(part)
    if expected.size is not None and size != expected.size:
        return f"the server sent {size} bytes, the hub lists {expected.size}", ""
    sha256 = hashlib.sha256()
    blob = hashlib.sha1(b"blob %d\0" % size, usedforsecurity=False)
    with part.open("rb") as file:
        while chunk := file.read(CHUNK):
            sha256.update(chunk)
            blob.update(chunk)
    for given, wanted in (
        (sha256.hexdigest(), expected.sha256),
        (blob.hexdigest(), expected.blob_sha1),
    ):
        if wanted and given != wanted:
            return (
                f"the server sent other bytes than the hub lists (hash {given[:12]}, not {wanted[:12]})",
                "",
            )
    return "", sha256.hexdigest()


def _open(
    url: str, start: int = 0, timeout: float | None = None
) -> http.client.HTTPResponse:
    """Ask for a file from byte ``start`` on. A fresh opener, since urllib's own keeps the proxies it saw first."""
    headers = {"User-Agent": f"mjhab/{__version__}", "Accept-Encoding": "identity"}
    if start:
        headers["Range"] = f"bytes={start}-"
    return build_opener().open(Request(url, headers=headers), timeout=timeout or TIMEOUT)


def _is_unreached(error: Exception) -> bool:
    """Whether no connection came about: no name, no way, nobody who listens, or silence."""
    return isinstance(error, URLError) and not isinstance(error, HTTPError)


def _is_silent(error: Exception) -> bool:
    """Whether nobody answered the request for a connection in time."""
    return isinstance(error, URLError) and isinstance(error.reason, TimeoutError)


def _worth_another_try(url: str, error: Exception) -> str:
    """Words for an error that may pass.

    Raises:
        TransferError: it will not.
    """
    if isinstance(error, HTTPError) and error.code not in _PASSING:
        hint = {
            401: "it needs an account",
            403: "it is not public",
            404: "it is not there",
        }.get(error.code, "")
        raise TransferError(f"{url}: {_refusal(error)}" + (f": {hint}." if hint else "."))
    if isinstance(error, HTTPError):
        return _refusal(error)
    if isinstance(error, TimeoutError):
        return _SILENT
    cause = error.reason if isinstance(error, URLError) else error
    return f"the connection failed ({one_line(str(cause))})"


def _refusal(error: HTTPError) -> str:
    return f"the server says {error.code} {one_line(str(error.reason))}"


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0
