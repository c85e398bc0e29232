"""Reading files that others wrote: bounded in size and depth, and one error for everything that is broken in them."""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mjhab.core.errors import about, fault, shown

MAX_JSON_MB = 256
"""Largest JSON text that is read [MB], after it was unpacked; 10,000 episodes in the HAB format take about 90."""
_MB = 2**20
_GZIP = b"\x1f\x8b"
_GZIP_WINDOW = 16 + zlib.MAX_WBITS
_MAX_SHOWN_CHARACTERS = 160


def check_file(path: Path, most_mb: float = math.inf) -> None:
    """Refuse what is no regular file.

    Raises:
        UsageError: it is missing, no regular file, or larger than ``most_mb``.
    """
    try:
        # A pipe or device would block or never end.
        if path.exists() and not path.is_file():
            raise fault(path, "not a file.")
        size = path.stat().st_size
    except (OSError, ValueError) as error:
        raise fault(path, f"cannot be read ({reason(error)}).") from error
    if size > most_mb * _MB:
        raise fault(path, f"{size / _MB:,.0f} MB; at most {most_mb:g} MB are read.")


def read_bytes(path: Path, most_mb: float = MAX_JSON_MB) -> bytes:
    """The content of a regular file.

    Raises:
        UsageError: it is missing, no regular file, unreadable, or larger than ``most_mb``.
    """
    check_file(path, most_mb)
    try:
        return path.read_bytes()
    except (OSError, ValueError) as error:
        raise fault(path, f"cannot be read ({reason(error)}).") from error


def is_file(path: Path) -> bool:
    """Whether there is such a file; False, too, for a name that no file can have, where `Path.is_file` may raise."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def is_folder(path: Path) -> bool:
    """Whether there is such a folder; False, too, for a name that none can have."""
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False


def beside(path: Path, name: str) -> Path:
    """The file that a file names, relative to its own folder; it need not exist.

    Args:
        path: the file that names it.
        name: what it says.

    Raises:
        ValueError: the name is none that a file can have.
    """
    try:
        found = path.parent / name
        found.is_file()
        return found
    except (OSError, ValueError) as error:
        raise ValueError(
            f"{shown(name)} is no name of a file ({reason(error)})"
        ) from error


def unpack_gzip(raw: bytes, most_mb: float = MAX_JSON_MB) -> bytes:
    """The content of gzip data; other data as they are.

    Raises:
        ValueError: the data are cut off or damaged, or hold more than ``most_mb``.
    """
    if not raw.startswith(_GZIP):
        return raw
    limit = int(most_mb * _MB)
    parts = []
    size = 0
    # A gzip file may consist of several parts, one after the other.
    while raw.startswith(_GZIP):
        stream = zlib.decompressobj(_GZIP_WINDOW)
        try:
            # One byte more than allowed tells a file of just the limit from a larger one.
            part = stream.decompress(raw, limit - size + 1)
        except zlib.error as error:
            raise ValueError(f"the gzip data is damaged ({error})") from error
        size += len(part)
        if size > limit:
            raise ValueError(
                f"the gzip data hold more than the {most_mb:g} MB that are read"
            )
        if not stream.eof:
            raise ValueError("the gzip data is cut off")
        parts.append(part)
        raw = stream.unused_data
    return b"".join(parts)


def parse_json(
    text: str | bytes, restore: Callable[[dict[str, Any]], Any] | None = None
) -> Any:
    """The value of a JSON text.

    Args:
        text: in UTF-8.
        restore: makes values of objects, as ``object_hook`` of `json.loads`.

    Raises:
        ValueError: no JSON in UTF-8; nested too deeply; an integer of thousands of digits.
    """
    try:
        plain = text if isinstance(text, str) else text.decode("utf-8")
        return json.loads(plain, object_hook=restore)
    except json.JSONDecodeError as error:
        raise ValueError(f"not valid JSON ({error})") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"not text in UTF-8 ({error})") from error
    # Python's parser recurses; a text of 100,000 brackets is valid JSON.
    except RecursionError as error:
        raise ValueError("not valid JSON (nested too deeply)") from error
    # Python refuses to read integers of more than 4,300 digits.
    except ValueError as error:
        raise ValueError(f"not valid JSON ({reason(error)})") from error


def read_json(path: Path, most_mb: float = MAX_JSON_MB) -> Any:
    """The value of a JSON file, ``.gz`` or plain.

    Raises:
        UsageError: see `read_bytes`, `unpack_gzip` and `parse_json`; names the file.
    """
    raw = read_bytes(path, most_mb)
    with about(path):
        return parse_json(unpack_gzip(raw, most_mb))


def read_json_object(path: Path, most_mb: float = MAX_JSON_MB) -> dict[str, Any]:
    """The object of a JSON file.

    Raises:
        UsageError: see `read_json`; or it holds something else than an object.
    """
    body = read_json(path, most_mb)
    if not isinstance(body, dict):
        raise fault(path, f"expected a JSON object, found {type(body).__name__}.")
    return body


def reason(error: BaseException) -> str:
    """What an exception of the system or of a library says, on one short line."""
    said = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return one_line(str(said))


def one_line(text: str) -> str:
    """A text of others on one short line."""
    line = " ".join(text.split())
    return (
        line
        if len(line) <= _MAX_SHOWN_CHARACTERS
        else f"{line[:_MAX_SHOWN_CHARACTERS]}..."
    )
