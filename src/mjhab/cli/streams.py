"""Robust output streams: terminals limited to ASCII, closed pipes, full disks."""

from __future__ import annotations

import io
import os
import sys

from mjhab.core.files.reading import reason


def make_streams_sturdy() -> None:
    """Make streams escape characters that they cannot encode, and replace closed streams by null devices."""
    sys.stdout = sys.stdout or io.StringIO()
    sys.stderr = sys.stderr or io.StringIO()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def drop_unwritable_stdout() -> None:
    """If stdout cannot be written, discard its buffered output, so that the interpreter exits without an error."""
    try:
        sys.stdout.flush()
    except (OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())


def described(error: OSError) -> str:
    """Describe an OSError for the user."""
    if error.filename is None:
        return f"cannot write the output ({reason(error)})."
    return f"{error.filename} cannot be used ({reason(error)})."
